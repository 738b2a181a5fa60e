"""A training and an experiment that are killed at random file operations end by the same command, with the same bytes.

`test_experiment_resume` kills in each kind of stage; here the moment is drawn, also between two stages, while a file is
renamed, or before the first byte. What may differ after kills is named in `MAY_DIFFER`.
"""

import random
import signal
import subprocess
import sys

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]  # a busy machine is slow

TEXT = """
about: Does a policy reach for an object that it never saw?
factors: {task: [pick_up], target: [cube, soda_can]}
unseen: [{target: cube}]
set: {distractors: {minimum: 0, maximum: 0}}
datasets:
  leave_out: {cells: seen, per_cell: 2}
conditions:
  leave_out: {train: leave_out}
trainers:
  bc:
    command: "roboxim train bc {dataset} --out {out} --seed {seed} --steps {steps}"
    until: "--until {until}"
    policy: bc
    steps: 6
evaluate: {per_cell: 1, max_steps: 4}
replicates: {count: 1}
compare: [{first: leave_out, second: leave_out, where: unseen, against: seen, primary: true}]
image_size: 64x64
"""
KILLED = """
import atexit, os, signal, sys
from pathlib import Path

left, place, note = int(sys.argv.pop(1)), sys.argv.pop(1), sys.argv.pop(1)
OPERATIONS = {"open", "os.rename", "os.link", "os.mkdir", "os.remove", "os.rmdir", "shutil.rmtree"}
done = 0

def hook(event, arguments):
    global done
    if event in OPERATIONS and place in str(arguments[0]):
        done += 1
        if done == left:
            os.kill(os.getpid(), signal.SIGKILL)

sys.argv[0] = "roboxim"
from roboxim_cli.main import main
atexit.register(lambda: Path(note).write_text(str(done)))
sys.addaudithook(hook)
main()
"""
"""The command ``roboxim``, killed at a numbered operation on files below a folder; 0: it counts them."""
KILLS = 5
LONGEST_S = 1800.0
MAY_DIFFER = {
    ".lock", "events.jsonl", "log", "stages.jsonl", "run.json", "runs.jsonl", "times.json", "state.json", "jobs",
}  # fmt: skip
"""Parts of paths of records of how a run went: starts, times, progress."""


def run(arguments, place, left, note):
    """Run a command; return the number of operations that it did, or None when it was killed."""
    command = [sys.executable, "-c", KILLED, str(left), str(place), str(note), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S)
    if done.returncode == -signal.SIGKILL:
        return None
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "Traceback" not in done.stdout + done.stderr
    return int(note.read_text())


def content(folder):
    """Return the files of a folder that must be equal, by path."""
    files = (path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path): (folder / path).read_bytes() for path in files if not MAY_DIFFER & set(path.parts)}


def after_kills(arguments, whole, cut, note):
    """Run a command to its end in one folder; in another one kill it at drawn operations first."""
    total = run(arguments(whole), whole, 0, note)
    rng, kills = random.Random(0), 0
    for _ in range(KILLS):
        kills += run(arguments(cut), cut, rng.randint(1, total), note) is None
    run(arguments(cut), cut, 0, note)
    assert kills >= 2, "the drawn operations came"


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    """Return the folder of an experiment, and that of one that was killed again and again."""
    folder = tmp_path_factory.mktemp("kills")
    (folder / "mine.yaml").write_text(TEXT)
    whole, cut = folder / "whole", folder / "cut"
    after_kills(
        lambda out: ["experiment", "run", folder / "mine.yaml", "--out", out, "--workers", "1"],
        whole, cut, folder / "count",
    )  # fmt: skip
    return whole, cut


def test_an_experiment_that_is_killed_at_any_time_ends_with_the_same_bytes(experiment):
    whole, cut = map(content, experiment)
    assert sorted(whole) == sorted(cut)
    assert [path for path in whole if whole[path] != cut[path]] == []


def test_a_training_that_is_killed_at_any_time_ends_with_the_same_bytes(experiment, tmp_path):
    (dataset,) = (experiment[0] / "export").iterdir()
    command = ["train", "bc", dataset, "--steps", 12, "--seed", 1, "--set", "checkpoint_every=2", "--out"]
    after_kills(lambda out: [*command, out], tmp_path / "whole", tmp_path / "cut", tmp_path / "count")
    whole, cut = content(tmp_path / "whole"), content(tmp_path / "cut")
    assert "checkpoint.npz" in whole
    assert whole == cut
