"""A contender that dies or hangs has failed; a fault of its script stops the benchmark."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("body", "said"),
    [("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "signal 9"), ("import time; time.sleep(60)", "hung")],
)
def test_a_contender_that_dies_or_hangs_has_failed(tmp_path: Path, body: str, said: str) -> None:
    from benchmarks.planner._contenders import Contender

    script = tmp_path / "run.py"
    script.write_text(f"print('{{\"ready\": true}}', flush=True)\ninput()\n{body}\n")
    with Contender("x", Path(sys.executable), str(script)) as contender:
        assert said in contender.ask({}, limit_s=1.0)["error"]


def test_a_fault_of_a_contenders_script_stops_the_benchmark(tmp_path: Path) -> None:
    from benchmarks.planner._contenders import Contender

    script = tmp_path / "run.py"
    script.write_text("print('{\"ready\": true}', flush=True)\ninput()\nraise KeyError('typo')\n")
    with Contender("x", Path(sys.executable), str(script)) as contender, pytest.raises(RuntimeError, match="typo"):
        contender.ask({}, limit_s=5.0)
