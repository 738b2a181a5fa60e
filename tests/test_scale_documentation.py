"""The scripts in docs/how-to/scale.md run every shard once; a Slurm array gives the folder of one run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from planted_runs import recordings

from roboxim_runs.episodes.generation import GenerationConfig, generate

TEXT = (Path(__file__).parents[1] / "docs" / "how-to" / "scale.md").read_text()
ROBOXIM = str(Path(sys.executable).parent / "roboxim")
SBATCH = """#!/bin/bash
# Runs each task of an array after the other, as Slurm would run them on nodes.
script=$1; shift
array=$(sed -n 's/^#SBATCH --array=//p' "$script")
export SLURM_CPUS_PER_TASK=1
for SLURM_ARRAY_TASK_ID in $(seq "${array%-*}" "${array#*-}"); do
  export SLURM_ARRAY_TASK_ID
  bash "$script" "$@" || exit 1
done
"""


def block(language: str) -> str:
    [found] = re.findall(rf"```{language}\n(.*?)```", TEXT, flags=re.DOTALL)
    return found


SCRIPT = block("bash")


@pytest.fixture
def sbatch(tmp_path):
    """Return a function that submits docs/how-to/scale.md's script to the stand-in."""
    bin_folder = tmp_path / "bin"
    bin_folder.mkdir()

    def run(roboxim, *words, script=SCRIPT):
        for name, text in (("sbatch", SBATCH), ("roboxim", roboxim)):
            (bin_folder / name).write_text(text)
            (bin_folder / name).chmod(0o755)
        (tmp_path / "shards.sh").write_text(script)
        path = f"{bin_folder}:{os.environ['PATH']}"
        return subprocess.run(
            ["sbatch", "shards.sh", *words], cwd=tmp_path, env={**os.environ, "PATH": path}, check=True,
            capture_output=True, text=True, timeout=600,
        ).stdout.splitlines()  # fmt: skip

    return run


def test_the_slurm_script_runs_every_shard_once(sbatch):
    calls = sbatch('#!/bin/bash\necho "$@"', "generate", "runs/demos", "--episodes", "10000")
    assert calls == [
        f"generate --out runs/demos-shards/{i} --shard {i}/8 --workers 1 --episodes 10000" for i in range(1, 9)
    ]


def test_the_kubernetes_job_runs_every_shard_once(tmp_path):
    job = yaml.safe_load(block("yaml"))["spec"]
    [container] = job["template"]["spec"]["containers"]
    (tmp_path / "roboxim").write_text('#!/bin/bash\necho "$@"')
    (tmp_path / "roboxim").chmod(0o755)
    calls = [
        subprocess.run(
            [*container["command"], *container["args"]], check=True, capture_output=True, text=True,
            env={"PATH": f"{tmp_path}:{os.environ['PATH']}", "JOB_COMPLETION_INDEX": str(index)},
        ).stdout.strip()
        for index in range(job["completions"])
    ]  # fmt: skip
    assert calls == [
        f"generate --episodes 10000 --workers 4 --out /runs/demos-shards/{i} --shard {i}/8" for i in range(1, 9)
    ]


@pytest.mark.ros
@pytest.mark.slow
def test_a_slurm_array_merged_is_one_run(sbatch, tmp_path):
    script = SCRIPT.replace("--array=1-8", "--array=1-2").replace("shards=8", "shards=2")
    small = ("--episodes", "2", "--size", "32", "--renderer", "tiny")
    sbatch(f'#!/bin/bash\nexec {ROBOXIM} "$@"', "generate", "demos", *small, script=script)
    subprocess.run([ROBOXIM, "merge", "demos-shards/1", "demos-shards/2", "--out", "demos"], cwd=tmp_path, check=True)
    generate(GenerationConfig(out=tmp_path / "whole", episodes=2, size=32, renderer="tiny", workers=1))
    assert recordings(tmp_path / "demos") == recordings(tmp_path / "whole")
