"""Golden episodes: a refactoring must not change a state, an image or an action, bit for bit.

`tests/golden.json` holds the hashes of each type of machine. Types of processors differ in the last bits of states (the
cause is not traced; NumPy and BLAS choose their instructions by the processor). Renew the hashes only for a deliberate
change, in a commit of its own that names the cause: ``.venv/bin/python tests/test_golden.py``. On a type of machine
that has none yet, ``tests/test_golden.py --add`` adds them; the code must be unchanged since the others were taken.
"""

import hashlib
import json
import platform
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.config import named_config
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_recorder.bag import BagReader

GOLDEN = Path(__file__).with_name("golden.json")
EPISODES = {
    "pick_cube_distractors": 0,
    "place_on": 1,
    "open_drawer": 2,
    "rotate": 3,
    "put_into": 4,
    "pick_cube_ur5": 0,
}
"""Episode indices by task; chosen to cover different skills, objects and motions."""
QUICK = ("pick_cube_distractors", "open_drawer")
"""Those of the default tests."""


def episode_hashes(task: str, index: int, folder: Path) -> dict[str, str]:
    """Record one demonstration and hash its parts."""
    text = named_config("tasks", task).read_text()  # with its own cameras; named on a command line it is seen whole
    config = RunConfig(
        run_seed=7, purpose="demo", task_config=text, image_width=64, image_height=64,
        noise_translation_m=0.003, noise_rotation_rad=0.01, output_dir=str(folder),
    )  # fmt: skip
    with CoreGraph(folder) as graph:
        result = EpisodeRunner(graph.ports, config).run_index(index)
    states, images, actions = (hashlib.blake2b(digest_size=16) for _ in range(3))
    for tick in BagReader(folder / result.bag).ticks():
        states.update(tick.state.state_hash.encode())
        actions.update(np.asarray([tick.step.action_label, tick.step.action_executed], np.float32).tobytes())
        for camera in sorted(tick.images):
            images.update(np.ascontiguousarray(tick.images[camera]).tobytes())
    return {
        "outcome": result.outcome,
        "ticks": str(result.last_seq),
        "states": states.hexdigest(),
        "actions": actions.hexdigest(),
        "images": images.hexdigest(),
    }


def machine() -> dict[str, str]:
    """Return the platform that bit-for-bit equality depends on besides the code: processor and software renderer."""
    with CoreGraph(Path(tempfile.gettempdir())) as graph:
        renderer = graph.sim.renderer
    facts = [line.partition(":") for line in Path("/proc/cpuinfo").read_text().splitlines()]
    first = {name.strip(): value.strip() for name, _, value in reversed(facts)}
    return {
        "processor": first.get("model name", platform.machine()),
        "family": f"{first.get('cpu family', '?')}.{first.get('model', '?')}",
        "avx512": str("avx512f" in first.get("flags", "").split()),
        "renderer": renderer,
    }


@pytest.mark.parametrize(
    "task", [task if task in QUICK else pytest.param(task, marks=pytest.mark.thorough) for task in EPISODES]
)
def test_an_episode_is_the_golden_one(task, tmp_path):
    golden = json.loads(GOLDEN.read_text())
    found = episode_hashes(task, EPISODES[task], tmp_path)
    if found not in [one["episodes"][task] for one in golden]:
        here = machine()
        same = [one["episodes"][task] for one in golden if one["machine"] == here]
        if not same:
            pytest.skip(f"no golden hashes were taken on this type of machine, {here}")
        assert found == same[0]


def renew(*, add: bool) -> None:
    """Write the hashes of the current code; those of other types of machines are kept if these are to be added."""
    episodes, here = {}, machine()
    for task, index in EPISODES.items():
        with tempfile.TemporaryDirectory() as folder:
            episodes[task] = episode_hashes(task, index, Path(folder))
        print(task, episodes[task])
    others = [one for one in json.loads(GOLDEN.read_text()) if one["machine"] != here] if add else []
    GOLDEN.write_text(json.dumps([*others, {"machine": here, "episodes": episodes}], indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(renew(add="--add" in sys.argv))
