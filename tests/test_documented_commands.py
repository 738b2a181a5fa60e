"""Every command that README.md and the documentation print is executed in a small size, or named here with a reason.

The commands of a page run one after the other in a folder that holds what a reader has by then: a small run, its
datasets, a checkpoint, an evaluation, policies, a skill and a mesh of one's own. Only sizes are reduced (`SMALL`,
`ADDED`). That commands parse is tested in test_documentation.py; tutorials are run by test_tutorials.py.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from roboxim_ros.testing import PATIENCE_S, eventually

sys.path.insert(0, str(Path(__file__).parent))

from test_documentation import ROOT, SHELL, commands  # noqa: E402

PROGRAM = Path(sys.executable).parent / "roboxim"
PAGES = sorted({block.file for block in SHELL if not block.file.startswith("docs/tutorials/")})
SMALL = {
    "--episodes": "3", "--steps": "2", "--size": "64", "--duration": "8", "--first": "1", "--fresh": "1",
    "--gate": "1", "--triangles": "300", "--workers": "1", "--share": "1",
}  # fmt: skip
"""Option to the value that it gets here instead of the documented one."""
ADDED = {
    "generate": ("--episodes", "3", "--size", "64", "--workers", "1"),
    "evaluate": ("--episodes", "8", "--size", "64", "--workers", "1", "--max-steps", "4"),
    "train bc": ("--steps", "2"),
    "compare-policies": ("--episodes", "1", "--size", "64"),
    "mine": ("--first", "6", "--rounds", "0", "--confirm", "6", "--size", "64"),
    "explain": ("--repeats", "3"),
    "sweep": ("--size", "64", "--workers", "1"),
    "rerender": ("--size", "64"),
}
"""Command to the options that it gets as well, where the documentation does not give them."""
NOT_RUN = {
    r"^demo ": "test_main_job.py, and .ci/run",
    r"--executor ray|--address": "a Ray cluster: test_ray_runs.py",
    r"s3://": "a store: test_stores.py",
    r"url=ws://": "a model's server: test_policy_servers.py",
    r"^(experiment run|benchmark transfer|pretrain) ": "minutes to hours of stages: .ci/run, test_experiment_shards.py",
    r"--depth-unit": "a dataset with depth: tests of roboxim_datasets",
    r"^(benchmark (mine/|report)|experiment (join|pack|compare)) ?": "runs: test_compared_models.py, test_packs.py",
    r"^experiment collect": "a card of all cells: test_collection.py",
    r"^merge '?runs/so": "finished shards: test_experiment_shards.py",
    r"^(experiment report|show) runs/(smoke|so|so-laptop)\b": "a run of minutes to hours: .ci/run",
    r"runs/ablation/|runs/broad/": "what a benchmark or a pre-training of minutes to hours leaves",
    r"^correlate ": "results of three policies or more, e.g. on real robots: test_correlating.py",
    r"demos-shards": "what many machines made: test_shards.py",
    r"/\.partial/": "what a killed recorder leaves: test_repair.py",
    r"my_arm|my_panda|sawyer": "an arm of the reader's: tests of roboxim_runs",
    r"request\.yaml": "a request of the reader's: roboxim_planner/tests",
    r"^experiment calibrate": "minutes of stages: test_experiment_resume.py",
    r"^audit-benchmark (gymnasium_robotics|metaworld):": "environments of others",
    r"--renderer photo": "Blender, which `make photo` installs: test_photo.py",
    r"^(assets check pepper_mill|tasks sample --skill shake|generate --skill shake)": "test_worked_example.py",
    r"^view push_at_night|--light disco": "the page's files: test_worked_example.py",
    r"^gymnasium serve|^studio ": "serve until they are stopped: test_gymnasium.py, roboxim_studio/tests",
}
"""Pattern of a command to the reason why it is not run here, and what runs it instead."""
SERVERS = ("up", "node planner", "policy serve", "bag record")
"""Commands that the next ones need running; `bag record` ends by itself."""
CODES = {
    r"position: \{x: 1\.5\}": 1,  # a goal out of reach, as the page says
}
"""Pattern of a command to the exit code that it has with these small data, if not 0."""
MODELS = """
from roboxim_policies import BasePolicy

class MyPolicy(BasePolicy):
    cameras = ("workspace",)

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain

    def act(self, window):
        return [0.0, 0.0, -0.01 * self.gain, 0.0, 0.0, 0.0, 1.0]

class Mine(MyPolicy):
    pass
"""
BRICK = """
import trimesh
trimesh.creation.box(extents=(0.05, 0.04, 0.03)).export("teapot.glb")
"""


def run(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command of RoboXim in a reader's folder."""
    return subprocess.run(
        [str(PROGRAM), *words], cwd=folder, env=environment(folder), capture_output=True, text=True, check=False,
        timeout=PATIENCE_S, stdin=subprocess.DEVNULL,
    )  # fmt: skip


def environment(folder: Path) -> dict[str, str]:
    """Return the variables of a reader's terminal: records of running graphs are this folder's own."""
    return {**os.environ, "XDG_STATE_HOME": str(folder / ".state"), "XDG_RUNTIME_DIR": str(folder / ".runtime")}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run and all that is made of it."""
    folder = tmp_path_factory.mktemp("made")
    tiny = ["--size", "64", "--workers", "2"]
    for words in (
        ["generate", "--episodes", "4", *tiny, "--out", "demos"],
        ["export", "rlds", "demos", "--out", "rlds"],
        ["train", "bc", "rlds", "--out", "bc", "--steps", "2"],
        ["evaluate", "--policy", "bc", "--checkpoint", "bc", "--policy", "random", "--episodes", "8",
         "--max-steps", "8", *tiny, "--out", "evaluation"],
    ):  # fmt: skip
        done = run(words, folder)
        assert done.returncode == 0, f"{shlex.join(words)}: {done.stdout}{done.stderr}"
    return folder


KINDS = {
    r"^runs/.*(demos|driven|so|new|colors)$": "demos",
    r"^runs/.*(rlds|rlds-\d)$|^(copy|copy/rlds|somebody/dataset)$": "rlds",
    r"^runs/.*(bc[-_\w]*|act)$": "bc",
    r"^runs/.*(evaluation|monday|tuesday)$": "evaluation",
    r"^(runs/so/)?card\.json$": "card.json",
}
"""Pattern of an input's path to what stands there, if no command of the page has made it."""


@pytest.fixture
def reader(made: Path, tmp_path: Path) -> Iterator[Path]:
    """A reader's folder: an own policy, skill and mesh; nothing goes on running in it after the test."""
    for name in ("my_policy.py", "other.py", "my_module.py", "my_model.py"):
        (tmp_path / name).write_text(MODELS)
    page = (ROOT / "docs/how-to/own_skill.md").read_text()
    (tmp_path / "my_skill.py").write_text(re.findall(r"```python\n# my_skill.py\n(.*?)```", page, re.DOTALL)[0])
    subprocess.run([sys.executable, "-c", BRICK], cwd=tmp_path, check=True)
    (tmp_path / ".runtime").mkdir()
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    (tmp_path / "teapot.yaml").write_text(run(["assets", "new", "teapot.glb"], tmp_path).stdout)
    (tmp_path / "scans").mkdir()
    subprocess.run([sys.executable, "-c", BRICK.replace("teapot.glb", "scans/teapot.obj")], cwd=tmp_path, check=True)
    yield tmp_path
    run(["down"], tmp_path)


def provide(words: list[str], folder: Path, made: Path) -> None:
    """Put what a command reads where no command of the page has put it."""
    written = words.index("--out") + 1 if "--out" in words else -1
    for place, word in enumerate(words):
        root = word.rpartition("=")[2].partition("/episodes/")[0]
        if place == written or not re.fullmatch(r"\w[\w/.-]*", root) or (folder / root).exists():
            continue
        for pattern, kind in KINDS.items():
            if re.search(pattern, root):
                if kind == "card.json":
                    (folder / root).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(ROOT / "docs/results/skill_object-night/card.json", folder / root)
                    break
                shutil.copytree(made / kind, folder / root)
                if kind == "rlds" and not (folder / root).with_name("demos").exists():  # its bags
                    shutil.copytree(made / "demos", (folder / root).with_name("demos"))
                break


def reduced(words: list[str]) -> list[str]:
    """Return a command with small sizes."""
    sizes = SMALL if words[0] != "evaluate" else {**SMALL, "--episodes": "8"}  # pages ask for the episode 7
    sizes = sizes if words[:2] != ["experiment", "plan"] else {"--scale": "smoke", "--budget": "1h"}
    small = [sizes.get(before, word) for before, word in zip(["", *words], words, strict=False)]
    for command, options in ADDED.items():
        if small[: len(command.split())] == command.split():
            pairs = zip(options[::2], options[1::2], strict=True)
            small += [part for pair in pairs if pair[0] not in small for part in pair]
    return small


def serves(words: list[str]) -> bool:
    return any(words[: len(name.split())] == name.split() for name in SERVERS)


@pytest.mark.thorough
@pytest.mark.ros
@pytest.mark.parametrize("page", PAGES)
def test_commands_of_a_page_run(page: str, reader: Path, made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    servers: list[subprocess.Popen[bytes]] = []
    try:
        for program, *words in (words for block in SHELL if block.file == page for words in commands(block.text)
                                if words and words != ["roboxim"]):  # fmt: skip
            if program == "export":
                name, _, value = words[0].partition("=")
                folder = value.replace("$PWD", str(reader))
                Path(folder).mkdir(parents=True, exist_ok=True)  # the reader's own files, which other tests write
                monkeypatch.setenv(name, folder)
            if program != "roboxim":
                continue
            text = shlex.join(words)
            if any(re.search(pattern, text) for pattern in NOT_RUN):
                continue
            provide(words, reader, made)
            small = reduced(words)
            if serves(small):
                servers.append(started(small, reader))
                continue
            if words[0] not in ("action", "service", "topic"):
                for server in servers:
                    if server.args[1:3] == ["bag", "record"]:
                        assert server.wait(PATIENCE_S) == 0
            done = run([part for word in small for part in expanded(word, reader)], reader)
            said = f"{page}: roboxim {text}\nrun as {shlex.join(small)}: {done.returncode}\n{done.stdout}{done.stderr}"
            assert "Traceback" not in said, said
            assert done.returncode == next((code for start, code in CODES.items() if re.search(start, text)), 0), said
    finally:
        for server in servers:
            server.terminate()
            server.wait(PATIENCE_S)


def started(words: list[str], folder: Path) -> subprocess.Popen[bytes]:
    """Start a command that serves, and return once it says that it does."""
    log = folder / f"{'-'.join(words[:2])}.log"  # each has its own: what one says must not stand for another
    with log.open("wb") as out:
        server = subprocess.Popen([PROGRAM, *words], cwd=folder, env=environment(folder), stdout=out, stderr=out)
    eventually(lambda: server.poll() is not None or re.search(r"\bis up\b|\bserves\b|\brecording\b", log.read_text()))
    assert server.poll() is None, log.read_text()
    return server


def expanded(word: str, folder: Path) -> list[str]:
    """Return the paths that a pattern of the shell means."""
    return sorted(str(path.relative_to(folder)) for path in folder.glob(word)) if "*" in word else [word]


def test_what_is_not_run_is_documented() -> None:
    texts = [shlex.join(words[1:]) for block in SHELL for words in commands(block.text) if words[:1] == ["roboxim"]]
    for pattern in (*NOT_RUN, *CODES):
        assert any(re.search(pattern, text) for text in texts), f"no page has it: {pattern}"
    cited = {name for reason in NOT_RUN.values() for name in re.findall(r"test_\w+\.py", reason)}
    assert cited <= {path.name for folder in ("src", "tests") for path in (ROOT / folder).rglob("test_*.py")}
    run = [text for text in texts if not any(re.search(pattern, text) for pattern in NOT_RUN)]
    assert len(run) >= 150
