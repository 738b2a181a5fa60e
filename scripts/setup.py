"""Install RoboXim into its checkout: tools, locked packages, generated interfaces, the `roboxim` command.

Everything lands in `.tools/` and `.venv/`; `make clean-all` removes both. Only Python 3.11, a C and C++ compiler and a
package index are needed.

Design. Each step has a key, a hash over all that its result depends on, stored beside the result when the step has
finished. A step whose key is stored already is skipped, so the second run does nothing. An environment being written
carries a `busy` mark, so that one left half made by Ctrl-C or a crash is thrown away, never taken for whole. Packages
are installed while the interfaces compile: the two do not depend on each other until the end.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ROOT / ".tools"
VENV = ROOT / ".venv"
BUILD_ENV = TOOLS / "build-env"
BUILD_DIR = TOOLS / "build" / "interfaces"
LOGS = TOOLS / "logs"
LOCKS = ROOT / "requirements"
INTERFACES = ROOT / "src" / "roboxim_interfaces"
UV = TOOLS / "uv" / "bin" / "uv"
PYTHON = os.path.realpath(getattr(sys, "_base_executable", None) or sys.executable)

# Of another ROS installation, another environment or ours: none of it may reach a build.
FOREIGN_VARIABLES = (
    "AMENT_PREFIX_PATH",
    "CMAKE_PREFIX_PATH",
    "COLCON_PREFIX_PATH",
    "CONDA_PREFIX",
    "PYTHONHOME",
    "PYTHONPATH",
    "VIRTUAL_ENV",
)
GL_PACKAGES = ("libegl1", "libgl1-mesa-dri")


class SetupError(Exception):
    """A step failed; the message says what to do about it."""


# --- the state of a result ------------------------------------------------------------------------------------------


def digest(*parts: str | Path) -> str:
    """Hash strings, and files by their content, into a key."""
    total = hashlib.sha256()
    for part in parts:
        total.update(part.read_bytes() if isinstance(part, Path) else part.encode())
        total.update(b"\0")
    return total.hexdigest()


def interface_files() -> list[Path]:
    """List the files that the generated interfaces depend on."""
    suffixes = {".msg", ".srv", ".action", ".cmake", ".xml", ".toml", ".txt"}
    return sorted(path for path in INTERFACES.rglob("*") if path.suffix in suffixes and path.is_file())


def interface_key() -> str:
    """Hash names and contents of the interface files, and what they are built with."""
    names = "\n".join(str(path.relative_to(INTERFACES)) for path in interface_files())
    return digest(names, *interface_files(), LOCKS / "build.lock", environment_key())


def environment_key() -> str:
    """Hash what makes an environment unusable when it changes: its interpreter and its place."""
    return digest(PYTHON, sys.version, str(ROOT))


def packages_key(lock: Path) -> str:
    """Hash what an environment made from a lock depends on."""
    return digest(lock, environment_key())


class Environment:
    """A virtual environment that knows which steps have been finished in it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.python = path / "bin" / "python"
        self._state = path / ".roboxim"

    def has(self, step: str, key: str) -> bool:
        """Tell whether the step was finished with this key, and nothing was interrupted since."""
        stamp = self._state / step
        if (self._state / "busy").exists() or not self.python.exists():
            return False
        return stamp.exists() and stamp.read_text() == key

    @contextlib.contextmanager
    def writing(self, step: str, key: str) -> Iterator[None]:
        """Mark the environment as half made while its body runs, and the step as finished after it."""
        (self._state / step).unlink(missing_ok=True)
        (self._state / "busy").touch()
        yield
        (self._state / step).write_text(key)
        (self._state / "busy").unlink()

    def make(self, lock: Path) -> None:
        """Make the environment anew, with exactly the packages of a lock.

        Always anew: the ROS wheels register themselves under a second name that no lock knows, so bringing an existing
        environment in line (`uv pip sync`) would remove half of ROS.
        """
        shutil.rmtree(self.path, ignore_errors=True)
        run(f"{self.path.name.lstrip('.')}-create", UV, "venv", "--quiet", "--python", PYTHON, self.path)
        self._state.mkdir()
        with self.writing("packages", packages_key(lock)):
            uv_pip(self, "install", "--require-hashes", "--no-deps", "--requirements", lock)


venv = Environment(VENV)
build_env = Environment(BUILD_ENV)


# --- running commands and telling about it --------------------------------------------------------------------------

started = time.monotonic()
running: dict[str, tuple[float, Path | None]] = {}  # step -> when it began, the log it writes now
current = threading.local()  # .step: the step that this thread is in
print_lock = threading.Lock()


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
    """Say what is running: every second in a terminal, every 20 s elsewhere."""
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


def describe(name: str) -> str:
    """Describe a running step by its age and the last line that it wrote."""
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
    """Return the process environment without the traces of any ROS or Python environment."""
    environment = {name: value for name, value in os.environ.items() if name not in FOREIGN_VARIABLES}
    if environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None):
        environment.pop("LD_LIBRARY_PATH", None)  # set by the ROS wheels of the environment that we were started from
    return environment


def run(name: str, *command: str | Path, cwd: Path = ROOT, extra: dict[str, str] | None = None) -> None:
    """Run a command, its output going to a log that is shown when it fails.

    Raises:
        SetupError: the command failed.
    """
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


# --- the steps ------------------------------------------------------------------------------------------------------


def require_build_tools() -> None:
    """Check for what only the system can provide.

    Raises:
        SetupError: a compiler or Python's headers are missing.
    """
    missing = []
    if not (shutil.which("cc") and shutil.which("c++")):
        missing.append(("a C and C++ compiler", "build-essential"))
    if not Path(sysconfig.get_path("include"), "Python.h").exists():
        missing.append((f"the headers of {PYTHON} (Python.h)", "python3.11-dev"))
    if missing:
        what = " and ".join(name for name, _ in missing)
        packages = " ".join(package for _, package in missing)
        raise SetupError(f"{what} needed to build the interfaces.\nOn Debian or Ubuntu: apt install {packages}")


def install_uv() -> None:
    """Install uv, the package installer, into `.tools/uv`."""
    key = digest(LOCKS / "uv.txt", environment_key())
    stamp = TOOLS / "uv" / ".roboxim"
    if UV.exists() and stamp.exists() and stamp.read_text() == key:
        return
    with step("uv"):
        shutil.rmtree(TOOLS / "uv", ignore_errors=True)
        pip = [PYTHON, "-m", "pip"]
        if subprocess.run([*pip, "--version"], capture_output=True, check=False).returncode != 0:
            environment = TOOLS / "pip"
            shutil.rmtree(environment, ignore_errors=True)
            try:
                run("pip", PYTHON, "-m", "venv", environment)
            except SetupError as error:
                raise SetupError("Python has neither pip nor venv. On Debian or Ubuntu: apt install python3.11-venv") from error
            pip = [str(environment / "bin" / "python"), "-m", "pip"]
        run("uv", *pip, "install", "--quiet", "--require-hashes", "--no-deps", "--target", TOOLS / "uv", "-r", LOCKS / "uv.txt")
        stamp.write_text(key)


def install_packages() -> None:
    """Install the locked packages into `.venv`."""
    lock = LOCKS / "dev.lock"
    if not venv.has("packages", packages_key(lock)):
        count = sum(line[:1].isalnum() for line in lock.read_text().splitlines())
        with step(f"{count} packages"):
            venv.make(lock)


def build_interfaces() -> Path:
    """Build the wheel of the generated interfaces, unless it exists for these files.

    Returns:
        The wheel.
    """
    folder = TOOLS / "wheels" / interface_key()[:16]
    wheels = list(folder.glob("*.whl"))
    if wheels:
        return wheels[0]
    require_build_tools()
    with step("interfaces"):
        if not build_env.has("packages", packages_key(LOCKS / "build.lock")):
            build_env.make(LOCKS / "build.lock")
            shutil.rmtree(BUILD_DIR, ignore_errors=True)
        forget_removed_interfaces()
        scratch = TOOLS / "wheels" / "new"
        shutil.rmtree(scratch, ignore_errors=True)
        command = (
            *(build_env.python, "-m", "build", "--wheel", "--no-isolation", "--skip-dependency-check"),
            *(f"--config-setting=build-dir={BUILD_DIR}", "--outdir", scratch),
        )
        retry = BUILD_DIR.exists()
        try:
            run("interfaces", *command, INTERFACES)
        except SetupError:
            if not retry:
                raise
            shutil.rmtree(BUILD_DIR, ignore_errors=True)  # what an earlier build left may be the cause
            run("interfaces", *command, INTERFACES)
        shutil.rmtree(folder, ignore_errors=True)
        scratch.rename(folder)
    return next(folder.glob("*.whl"))


def forget_removed_interfaces() -> None:
    """Throw the build folder away when an interface file is gone: what was generated from it would stay in the wheel."""
    record = BUILD_DIR.with_suffix(".json")
    names = [str(path.relative_to(INTERFACES)) for path in interface_files()]
    known = json.loads(record.read_text()) if record.exists() else names
    if set(known) - set(names):
        shutil.rmtree(BUILD_DIR, ignore_errors=True)
    record.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps(names))


def install_ours(wheel: Path) -> None:
    """Install the interfaces and, editable, RoboXim itself into `.venv`."""
    interfaces = wheel.parent.name
    project = digest(ROOT / "pyproject.toml")
    if not venv.has("interfaces", interfaces):
        with venv.writing("interfaces", interfaces):
            uv_pip(venv, "install", "--offline", "--no-deps", "--reinstall", wheel)
    if not venv.has("project", project) or not (VENV / "bin" / "roboxim").exists():
        with venv.writing("project", project):
            uv_pip(venv, "install", "--offline", "--no-deps", "--no-build-isolation", "--reinstall", "--editable", ROOT)


def install_gl() -> None:
    """Install the libraries that render cameras where that can be done, otherwise say how to."""
    if not shutil.which("dpkg-query"):
        return
    found = subprocess.run(
        ["dpkg-query", "--show", "--showformat", "${db:Status-Status} ${Package}\n", *GL_PACKAGES],
        capture_output=True,
        text=True,
        check=False,
    ).stdout.splitlines()
    missing = [package for package in GL_PACKAGES if f"installed {package}" not in found]
    if not missing:
        return
    command = f"apt-get install -y --no-install-recommends {' '.join(missing)}"
    if os.geteuid() == 0 and shutil.which("apt-get") and not os.environ.get("ROBOXIM_NO_APT"):
        try:
            with step("system libraries"):
                quiet = {"DEBIAN_FRONTEND": "noninteractive"}
                run("apt-update", "apt-get", "update", extra=quiet)
                run("apt-install", *command.split(), extra=quiet)
            return
        except SetupError as error:
            say(f"  {error}")
    say(f"  Cameras fall back to PyBullet's own renderer until this is run as root: {command}")


@contextlib.contextmanager
def only_one() -> Iterator[None]:
    """Hold the checkout's set-up lock."""
    TOOLS.mkdir(exist_ok=True)
    with (TOOLS / "setup.lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("Another `make setup` is running in this checkout; waiting for it.")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def set_up() -> None:
    """Run every step that is not done yet."""
    install_uv()
    lanes: list[Callable[[], object]] = [install_gl, install_packages, build_interfaces]
    with ThreadPoolExecutor(len(lanes)) as pool:
        futures = [pool.submit(lane) for lane in lanes]
        wait(futures, return_when=FIRST_EXCEPTION)
        for future in futures:
            future.result()
    install_ours(build_interfaces())


def main() -> int:
    """Set the checkout up and say how long it took."""
    stop = threading.Event()
    progress = threading.Thread(target=show_progress, args=(stop,), daemon=True)
    try:
        with only_one():
            progress.start()
            set_up()
    except SetupError as error:
        say(f"make setup: {error}")
        return 1
    except KeyboardInterrupt:
        say("make setup: interrupted; run it again to go on")
        return 130
    finally:
        stop.set()
    seconds = time.monotonic() - started
    say(f"RoboXim is set up ({seconds:.1f} s): .venv/bin/roboxim --help")
    return 0


if __name__ == "__main__":
    sys.exit(main())
