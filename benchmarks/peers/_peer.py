"""A peer program from another environment under `.tools/`, which a benchmark measures in the same run as RoboXim."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]
TOOLS = HERE.parent / ".tools"
_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH")


class Peer:
    """A script in ``peers/`` that implements the protocol of ``peers/_serve.py``."""

    def __init__(self, environment: str, script: str, *arguments: str, variables: dict[str, str] | None = None) -> None:
        """Start the script and wait until it is ready.

        Args:
            environment: Name of the environment; see `installed`.
            script: Name of the script.
            arguments: Its arguments.
            variables: Additional environment variables.
        """
        clean = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
        if clean.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None):
            clean.pop("LD_LIBRARY_PATH", None)  # set by the ROS wheels of our environment
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed in close()
        self._process = subprocess.Popen(
            [_python(environment), HERE / "peers" / script, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env={**clean, **(variables or {})},
            text=True,
        )
        self._read()

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request and return the response."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._read()

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=30)
        self._log.close()

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._log.seek(0)
            raise SystemExit(f"{self._process.args[1]} ended:\n{self._log.read()[-2000:]}")  # type: ignore[index]
        answer: dict[str, Any] = json.loads(line)
        return answer


def installed(environment: str) -> bool:
    """Return whether an environment is installed."""
    return _python(environment).exists()


def _python(environment: str) -> Path:
    return TOOLS / f"{environment}-env" / "bin" / "python"
