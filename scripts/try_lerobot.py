"""Evaluate with the genuine `lerobot` in an environment that has nothing but wheels: `make try-lerobot`.

An empty environment of Python 3.12, which LeRobot needs, outside of the checkout receives RoboXim's wheels,
`lerobot_env_roboxim` and the newest lerobot that it allows (6 GB, NVIDIA's libraries included). There

- LeRobot's `make_env` makes the environment, and the actions of RoboXim's expert, stepped through it, must succeed;
- `lerobot-eval` evaluates a policy of LeRobot (ACT with random weights) and must count two episodes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from environments import UV, SetupError, clean_environment, index_settings, say, show_progress, step
from release import DIST, PURE, compiled_wheels, interpreter

PYTHON = "3.12"
SIZE_PX = 64
EXPERT = f"""
from pathlib import Path
import numpy as np
from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_recorder.bag import BagReader
from roboxim_runs.episodes.task_choice import task_text

folder = Path("expert").resolve()
config = RunConfig(
    run_seed=5, purpose="eval", task_config=task_text("pick_cube"), image_width={SIZE_PX}, image_height={SIZE_PX},
    output_dir=str(folder),
)
with CoreGraph(folder) as cores:
    result = EpisodeRunner(cores.ports, config).run_index(0)
assert result.outcome == "success", result
ticks = list(BagReader(folder / result.bag).ticks())
np.save("actions.npy", [tick.step.action_executed for tick in ticks[1 : result.steps + 1]])
"""
"""Write the actions with which the expert solves the first scene of seed 5."""
DRIVE = f"""
import sys
import numpy as np
from lerobot.envs.factory import make_env, make_env_config
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
made = make_env(make_env_config("roboxim", task="pick_cube", size={SIZE_PX}, url=sys.argv[1]), n_envs=1)
env = made["pick_cube"][0]
observation, info = env.reset(seed=[5])
assert observation["pixels"]["wrist"].shape == (1, {SIZE_PX}, {SIZE_PX}, 3), observation
actions = np.load("actions.npy").astype(np.float32)
for number, action in enumerate(actions, start=1):
    observation, reward, terminated, truncated, info = env.step(action[None])
    assert bool(terminated[0]) == (number == len(actions)), (number, info)
assert info["final_info"]["is_success"][0] and reward[0] == 1, (reward, info)
env.close()
print(f"success after {{len(actions)}} actions")
"""
"""Step them through the environment that LeRobot makes; it must report success with the last one."""
POLICY = f"""
from lerobot.configs import FeatureType
from lerobot.envs.factory import make_env_config
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
features = env_to_policy_features(make_env_config("roboxim", task="pick_cube", size={SIZE_PX}))
outputs = {{name: part for name, part in features.items() if part.type is FeatureType.ACTION}}
config = ACTConfig(
    input_features={{name: part for name, part in features.items() if name not in outputs}}, output_features=outputs,
    device="cpu", pretrained_backbone_weights=None, chunk_size=10, n_action_steps=10, dim_model=64, n_heads=2,
    dim_feedforward=64,
)
for part in (ACTPolicy(config), *make_pre_post_processors(config, dataset_stats=None)):
    part.save_pretrained("policy")
"""
"""Write a policy of LeRobot, with random weights."""

VERSIONS = """
import json
from importlib.metadata import version
print(json.dumps({name: version(name) for name in ("lerobot", "torch", "roboxim", "lerobot_env_roboxim")}))
"""


def wheels() -> list[Path]:
    """Return the wheels of `dist/`, or wheels of these sources if it has none for this Python."""
    tag = f"cp{PYTHON.replace('.', '')}"
    if list(DIST.glob(f"roboxim_interfaces-*{tag}*.whl")):
        return [path for path in DIST.glob("*.whl") if tag in path.name or "py3-none" in path.name]
    folder = Path(tempfile.mkdtemp(prefix="roboxim-wheels-"))
    for source in PURE:
        command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
        subprocess.run(command, cwd=source, check=True, capture_output=True)
    return [*folder.glob("*.whl"), *compiled_wheels(PYTHON)]


class Trial:
    """An empty environment in a folder, and commands that run in it.

    Args:
        folder: An empty folder outside of the checkout; it becomes the home of the commands.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.python = folder / "venv" / "bin" / "python"
        self.settings = {
            **(clean_environment() | index_settings()),
            **{"HOME": str(folder), "HF_HUB_OFFLINE": "1", "PATH": f"{self.python.parent}:/usr/bin:/bin"},
        }
        self._cache = subprocess.run([UV, "cache", "dir"], capture_output=True, text=True, check=True).stdout.strip()

    def do(self, *command: str | Path) -> str:
        """Run a command; return what it printed.

        Raises:
            SetupError: It failed.
        """
        done = subprocess.run(
            [str(part) for part in command], cwd=self.folder, env=self.settings | {"UV_CACHE_DIR": self._cache},
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        )  # fmt: skip
        if done.returncode != 0:
            raise SetupError(f"{done.stdout[-3000:]}\n{command[0]} failed")
        return done.stdout

    def install(self) -> dict[str, str]:
        """Install the wheels and lerobot; return the versions of what matters."""
        self.do(UV, "venv", "--python", interpreter(PYTHON), self.folder / "venv")
        self.do(UV, "pip", "install", "--python", self.python, *wheels())
        return dict(json.loads(self.do(self.python, "-c", VERSIONS)))

    def evaluate(self) -> dict[str, int | float | str]:
        """Solve a task through LeRobot's `make_env`, and run `lerobot-eval`.

        Returns:
            What the first printed, and LeRobot's own summary of the second.
        """
        self.do(self.python, "-c", EXPERT)
        with (self.folder / "server.log").open("w") as log:
            server = subprocess.Popen(
                [self.python.parent / "roboxim", "gymnasium", "serve", "--port", "0"],
                cwd=self.folder, env=self.settings, stdout=subprocess.PIPE, stderr=log, text=True,
            )  # fmt: skip
            try:
                assert server.stdout is not None
                url = server.stdout.readline().partition(" at ")[2].partition(";")[0]
                if not url:
                    raise SetupError((self.folder / "server.log").read_text())
                driven = self.do(self.python, "-c", DRIVE, url).strip().splitlines()[-1]
                self.do(self.python, "-c", POLICY)
                self.do(
                    *("lerobot-eval", "--policy.path=policy", "--policy.device=cpu", "--output_dir=evaluation"),
                    *("--env.type=roboxim", "--env.task=pick_cube", f"--env.size={SIZE_PX}", f"--env.url={url}"),
                    *("--env.episode_length=10", "--eval.n_episodes=2", "--eval.batch_size=1"),
                )
            finally:
                server.terminate()
                server.wait()
        overall = json.loads((self.folder / "evaluation" / "eval_info.json").read_text())["overall"]
        return {"make_env": driven, "episodes": overall["n_episodes"], "pc_success": overall["pc_success"]}


def main() -> int:
    """Install, evaluate, and print versions and results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    threading.Thread(target=show_progress, args=(threading.Event(),), daemon=True).start()
    with tempfile.TemporaryDirectory(prefix="roboxim-lerobot-") as folder:
        trial = Trial(Path(folder))
        try:
            with step("an empty environment with lerobot"):
                versions = trial.install()
            with step("make_env and lerobot-eval"):
                result = trial.evaluate()
        except SetupError as error:
            say(f"make try-lerobot: {error}")
            return 1
    say(json.dumps(versions | result, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
