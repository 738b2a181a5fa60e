"""Virtual environments that record their completed steps, and commands whose output is shown on failure.

`set_up.py` and the scripts for other environments share this module. It imports nothing of RoboXim, because it runs
before RoboXim is installed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ROOT / ".tools"
LOGS = TOOLS / "logs"
LOCKS = ROOT / "requirements"
UV = TOOLS / "uv" / "bin" / "uv"
PYTHON = os.path.realpath(getattr(sys, "_base_executable", None) or sys.executable)

EVERY_PYTHON = ("build", "dev", "installer", "release", "robots", "scale")
"""Locks for each Python that RoboXim runs on; the others are for 3.11, which their packages want."""

# Variables of a ROS installation or a Python environment, which must not reach a build.
FOREIGN_VARIABLES = (
    "AMENT_PREFIX_PATH",
    "CMAKE_PREFIX_PATH",
    "COLCON_PREFIX_PATH",
    "CONDA_PREFIX",
    "PYTHONHOME",
    "PYTHONPATH",
    "VIRTUAL_ENV",
)


class SetupError(Exception):
    """A step failed; the message says how to fix it."""


running: dict[str, tuple[float, Path | None]] = {}  # step -> its start time and its current log
current = threading.local()  # .step: the current step of this thread
print_lock = threading.Lock()
interrupted = threading.Event()  # set by Ctrl-C: start no further command


def say(text: str) -> None:
    """Print one line, clearing the status line of a terminal."""
    with print_lock:
        clear = "\r\033[K" if sys.stdout.isatty() else ""
        print(f"{clear}{text}", flush=True)


@contextlib.contextmanager
def step(name: str) -> Iterator[None]:
    """Announce a step, and its duration when it has finished."""
    begun = time.monotonic()
    current.step = name
    running[name] = (begun, None)
    say(f"  {name} ...")
    try:
        yield
    finally:
        running.pop(name, None)
    say(f"  {name}: done in {time.monotonic() - begun:.1f} s")


def show_progress(stop: threading.Event) -> None:
    """Print the running steps: every second in a terminal, every 20 s otherwise."""
    terminal = sys.stdout.isatty()
    while not stop.wait(1.0 if terminal else 20.0):
        status = " | ".join(describe(name) for name in list(running))
        if not status:
            continue
        with print_lock:
            if terminal:
                width = shutil.get_terminal_size().columns - 1
                print(f"\r\033[K  {status}"[: width + 4], end="", flush=True)
            else:
                print(f"    {status}", flush=True)


def reported(work: Callable[[], None]) -> int:
    """Do work and print the running steps meanwhile; return the exit status."""
    stop = threading.Event()
    threading.Thread(target=show_progress, args=(stop,), daemon=True).start()
    try:
        work()
    except SetupError as error:
        say(str(error))
        return 1
    finally:
        stop.set()
    return 0


def describe(name: str) -> str:
    """Describe a running step by its duration and the last line of its log."""
    begun, log = running.get(name, (time.monotonic(), None))
    line = last_line(log) if log else ""
    return f"{name} {time.monotonic() - begun:.0f} s" + (f": {line}" if line else "")


def last_line(log: Path) -> str:
    """Return the last line of a growing log, shortened."""
    with contextlib.suppress(OSError), log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - 2000))
        lines = [line.strip() for line in file.read().decode(errors="replace").splitlines()]
        return next((line for line in reversed(lines) if line), "")[:60]
    return ""


def clean_environment() -> dict[str, str]:
    """Return the process environment without variables of ROS and Python environments."""
    environment = {name: value for name, value in os.environ.items() if name not in FOREIGN_VARIABLES}
    if environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None):
        environment.pop("LD_LIBRARY_PATH", None)  # set by the ROS wheels of the calling environment
    return environment


def run(name: str, *command: str | Path, cwd: Path = ROOT, extra: dict[str, str] | None = None) -> None:
    """Run a command and log its output; show the log when the command fails.

    Raises:
        SetupError: The command failed, or Ctrl-C was pressed.
    """
    if interrupted.is_set():
        raise SetupError("interrupted")
    log = LOGS / f"{name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    step_name = getattr(current, "step", None)
    if step_name in running:
        running[step_name] = (running[step_name][0], log)
    with log.open("wb") as output:
        result = subprocess.run(
            [str(part) for part in command],
            cwd=cwd,
            env=clean_environment() | (extra or {}),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            check=False,
        )
    if result.returncode != 0:
        tail = "\n".join(line[:300] for line in log.read_text(errors="replace").splitlines()[-25:])
        shown = " ".join(str(part) for part in command)
        raise SetupError(f"{tail}\n\n`{shown}` failed; the whole output is in {log.relative_to(ROOT)}")


def uv_pip(environment: Environment, *arguments: str | Path) -> None:
    """Run `uv pip` on an environment, with the index and certificates that pip is configured with."""
    command, *rest = arguments
    name = f"{environment.path.name.lstrip('.')}-{command}"
    run(name, UV, "pip", command, "--python", environment.python, *rest, extra=index_settings())


def index_settings() -> dict[str, str]:
    """Translate pip's index and certificate settings to uv's, unless uv has its own."""
    result = subprocess.run([PYTHON, "-m", "pip", "config", "list"], capture_output=True, text=True, check=False)
    settings = {}
    for line in result.stdout.splitlines():
        key, _, value = line.partition("=")
        settings[key.split(".")[-1]] = value.strip("'\"")
    translated = {}
    if "index-url" in settings and not {"UV_DEFAULT_INDEX", "UV_INDEX_URL"} & os.environ.keys():
        translated["UV_DEFAULT_INDEX"] = settings["index-url"]
    if "cert" in settings and "SSL_CERT_FILE" not in os.environ:
        translated["SSL_CERT_FILE"] = settings["cert"]
    return translated


def digest(*parts: str | Path) -> str:
    """Hash strings, and files by their content, into a key."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part.read_bytes() if isinstance(part, Path) else part.encode())
        total.update(b"\0")
    return total.hexdigest()


def environment_key(python: str = PYTHON) -> str:
    """Hash an environment's interpreter and path, whose change makes the environment unusable."""
    return digest(python, sys.version, str(ROOT))


def packages_key(lock: Path, python: str = PYTHON) -> str:
    """Hash everything that an environment made from a lock depends on."""
    return digest(lock, environment_key(python))


class Environment:
    """A virtual environment that records which steps have finished in it."""

    def __init__(self, path: Path, base: str = PYTHON) -> None:
        self.path = path
        self.base = base
        self.python = path / "bin" / "python"
        self._state = path / ".roboxim"

    def has(self, step: str, key: str) -> bool:
        """Return whether the step finished with this key and no later step was interrupted."""
        stamp = self._state / step
        if (self._state / "busy").exists() or not self.python.exists():
            return False
        return stamp.exists() and stamp.read_text() == key

    @contextlib.contextmanager
    def writing(self, step: str, key: str) -> Iterator[None]:
        """Mark the environment as incomplete while the body runs, and the step as finished afterwards."""
        (self._state / step).unlink(missing_ok=True)
        (self._state / "busy").touch()
        yield
        (self._state / step).write_text(key)
        (self._state / "busy").unlink()

    def make(self, lock: Path) -> None:
        """Create the environment from scratch, with exactly the packages of a lock.

        The ROS wheels register themselves under a second name that no lock contains, so updating an existing
        environment (`uv pip sync`) would remove half of ROS.
        """
        shutil.rmtree(self.path, ignore_errors=True)
        base = self.base if lock.stem in EVERY_PYTHON else "3.11"
        run(f"{self.path.name.lstrip('.')}-create", UV, "venv", "--quiet", "--python", base, self.path)
        self._state.mkdir()
        with self.writing("packages", packages_key(lock, self.base)):
            uv_pip(self, "install", "--require-hashes", "--no-deps", "--requirements", lock)
