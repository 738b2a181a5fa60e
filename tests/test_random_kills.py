"""A training and an experiment that are killed at random file operations end by the same command, with the same bytes.

`test_experiment_resume` kills in each kind of stage; here the moment is drawn, also between two stages, while a file is
renamed, or before the first byte. What may differ after kills is named in `MAY_DIFFER`.
"""

import json
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
MAY_DIFFER = {".lock", "events.jsonl", "logs", "stages.jsonl", "run.json", "card.json", "report.html", "pages"}
"""Parts of paths of what records how a run went: starts, times, progress and the output of its processes, which pages
show, too. A card is compared by its checksum."""
TIMES = ("wall_s", "inference_s", "checksum")
"""What may differ in a line of ``results.jsonl``."""


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
    """Return the files of a folder that must be equal, by path, and the checksum of its card."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if not path.is_file() or MAY_DIFFER & set(name.parts) or path.suffix == ".log":
            continue
        found[str(name)] = path.read_bytes()
        if name.name == "results.jsonl":
            lines = map(json.loads, path.read_text().splitlines())
            found[str(name)] = sorted(str({k: v for k, v in line.items() if k not in TIMES}) for line in lines)
    if (folder / "card.json").exists():
        found["sha256"] = json.loads((folder / "card.json").read_text())["sha256"]
    return found


def after_kills(arguments, folder):
    """Run a command to its end; then, at the same place, kill it at drawn operations first. Return both contents."""
    out, note = folder / "out", folder / "count"
    total = run(arguments(out), out, 0, note)
    out.rename(folder / "whole")
    rng, kills = random.Random(0), 0
    for _ in range(KILLS):
        kills += run(arguments(out), out, rng.randint(1, total // 4), note) is None
    run(arguments(out), out, 0, note)
    assert kills >= 2, "the drawn operations came"
    return content(folder / "whole"), content(out)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    """Return the folder of an experiment, its content, and that after kills."""
    folder = tmp_path_factory.mktemp("kills")
    (folder / "mine.yaml").write_text(TEXT)
    command = ["experiment", "run", folder / "mine.yaml", "--workers", "1", "--out"]
    return folder, *after_kills(lambda out: [*command, out], folder)


def test_an_experiment_that_is_killed_at_any_time_ends_with_the_same_bytes(experiment):
    _, whole, cut = experiment
    assert sorted(whole) == sorted(cut)
    assert [path for path in whole if whole[path] != cut[path]] == []


def test_a_training_that_is_killed_at_any_time_ends_with_the_same_bytes(experiment, tmp_path):
    (dataset,) = (experiment[0] / "out/export").iterdir()
    command = ["train", "bc", dataset, "--steps", 12, "--seed", 1, "--set", "checkpoint_every=2", "--out"]
    whole, cut = after_kills(lambda out: [*command, out], tmp_path)
    assert "checkpoint.npz" in whole
    assert whole == cut
