"""Install RoboXim into its checkout: tools, locked packages, compiled packages, the `roboxim` command.

All files go to `.tools/` and `.venv/`; `make clean-all` removes both. Requirements: Python 3.11 to 3.13, a C and
C++ compiler, and a package index.

Design:

- Each step has a key, a hash over everything that its result depends on. The key is stored beside the result when the
  step has finished. A step whose key is already stored is skipped, so a second run does nothing.
- An environment that is being written has a `busy` mark. If Ctrl-C or a crash leaves it incomplete, the next run
  discards it.
- Packages are installed while RoboXim's own compile, because both are independent until the end. The interfaces
  generate code on one core for a third of their time; meanwhile the planner's kernel compiles on another one.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NoReturn

from environments import (
    LOCKS,
    PYTHON,
    ROOT,
    TOOLS,
    UV,
    Environment,
    SetupError,
    digest,
    environment_key,
    interrupted,
    packages_key,
    run,
    say,
    show_progress,
    step,
    uv_pip,
)

WHEELS_KEPT = 5  # of each member, so that switching branches does not rebuild them
VERSION = "{}.{}".format(*sys.version_info)
GL_PACKAGES = ("libegl1", "libgl1-mesa-dri")

venv = Environment(ROOT / ".venv")
build_env = Environment(TOOLS / "build-env")
started = time.monotonic()


@dataclass(frozen=True)
class Member:
    """A compiled distribution of RoboXim: built into a wheel and installed from it."""

    name: str
    folder: Path

    @property
    def build_dir(self) -> Path:
        """Build folder; kept, so that the next build compiles changed files only."""
        return TOOLS / "build" / self.name

    @property
    def wheels(self) -> Path:
        """Folder of its wheels, each in a subfolder named by its key."""
        return TOOLS / "wheels" / self.name

    def files(self) -> list[Path]:
        """List the files that it depends on."""
        files = (path for path in self.folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
        others = (self.folder / "README.md", self.folder / "tests")
        return sorted(path for path in files if not any(path.is_relative_to(other) for other in others))

    def key(self, version: str = sys.version) -> str:
        """Hash the names and contents of its files, its build tools, and the version of Python."""
        names = "\n".join(str(path.relative_to(self.folder)) for path in self.files())
        return digest(names, *self.files(), LOCKS / "build.lock", version, platform.platform(terse=True))

    def wheel(self, version: str = sys.version) -> Path | None:
        """Return the wheel for these files, if this checkout or another one has built it."""
        key = self.key(version)[:16]
        found = next((self.wheels / key).glob("*.whl"), None)
        if found is None and (cache := wheel_cache()):
            found = next((cache / self.name / key).glob("*.whl"), None)
        return found

    def keep(self, folder: Path) -> None:
        """Copy a built wheel into the cache, for other checkouts."""
        if cache := wheel_cache():
            with contextlib.suppress(OSError):  # a home that cannot be written
                kept = cache / self.name / folder.name
                scratch = kept.with_suffix(f".{os.getpid()}")
                shutil.copytree(folder, scratch)
                scratch.rename(kept)


def wheel_cache() -> Path | None:
    """Return the user's folder of built wheels; ``ROBOXIM_WHEEL_CACHE`` names another one, or none if it is empty."""
    chosen = os.environ.get("ROBOXIM_WHEEL_CACHE")
    if chosen is None:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "roboxim" / "wheels"
    return Path(chosen) if chosen else None


MEMBERS = (
    Member("interfaces", ROOT / "src" / "roboxim_interfaces"),
    Member("planner-native", ROOT / "src" / "roboxim_planner_native"),
)


def require_build_tools() -> None:
    """Check the requirements that only the system can provide.

    Raises:
        SetupError: A compiler or Python's headers are missing.
    """
    missing = []
    if not (shutil.which("cc") and shutil.which("c++")):
        missing.append(("a C and C++ compiler", "build-essential"))
    if not Path(sysconfig.get_path("include"), "Python.h").exists():
        missing.append((f"the headers of {PYTHON} (Python.h)", f"python{VERSION}-dev"))
    if missing:
        what = " and ".join(name for name, _ in missing)
        packages = " ".join(package for _, package in missing)
        raise SetupError(
            f"{what} needed to compile interfaces and kernel.\nOn Debian or Ubuntu: apt install {packages}"
        )


def install_uv() -> None:
    """Install uv, the package installer, into `.tools/uv`."""
    key = digest(LOCKS / "installer.lock", environment_key())
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
                raise SetupError(
                    f"Python has no pip and no venv; on Debian or Ubuntu: apt install python{VERSION}-venv"
                ) from error
            pip = [str(environment / "bin" / "python"), "-m", "pip"]
        pip += ["install", "--quiet", "--require-hashes", "--no-deps", "--target", str(TOOLS / "uv")]
        run("uv", *pip, "--requirement", LOCKS / "installer.lock")
        stamp.write_text(key)


def install_packages() -> None:
    """Install the locked packages into `.venv`."""
    lock = LOCKS / "dev.lock"
    if not venv.has("packages", packages_key(lock)):
        count = sum(line[:1].isalnum() for line in lock.read_text().splitlines())
        with step(f"{count} packages"):
            venv.make(lock)


def build_members() -> dict[Member, Path]:
    """Build the wheels of the compiled distributions, unless they exist for these files.

    Returns:
        The wheel of each.
    """
    if missing := [member for member in MEMBERS if member.wheel() is None]:
        at_once([partial(build, member) for member in missing])
    return {member: wheel for member in MEMBERS if (wheel := member.wheel()) is not None}


def make_build_environment() -> None:
    """Install the build tools, unless they are there or nothing has to be built."""
    if all(member.wheel() for member in MEMBERS):
        return
    require_build_tools()
    if not build_env.has("packages", packages_key(LOCKS / "build.lock")):
        with step("build tools"):
            build_env.make(LOCKS / "build.lock")
            shutil.rmtree(TOOLS / "build", ignore_errors=True)


def build(member: Member) -> None:
    """Build a member's wheel."""
    with step(member.name):
        folder = member.wheels / member.key()[:16]
        forget_removed_files(member)
        scratch = member.wheels / "new"
        shutil.rmtree(scratch, ignore_errors=True)
        command = (
            *(build_env.python, "-m", "build", "--wheel", "--no-isolation", "--skip-dependency-check"),
            *(f"--config-setting=build-dir={member.build_dir}", "--outdir", scratch),
        )
        try:
            run(member.name, *command, member.folder)
        except SetupError as error:
            hint = "" if interrupted.is_set() else "\nIf no file of it is wrong: make clean, then make setup again."
            raise SetupError(f"{error}{hint}") from error
        scratch.rename(folder)
        member.keep(folder)
        for old in sorted(folder.parent.iterdir(), key=lambda path: path.stat().st_mtime)[:-WHEELS_KEPT]:
            shutil.rmtree(old)


def forget_removed_files(member: Member) -> None:
    """Delete the build folder when a file of the member was removed: its outputs would otherwise stay in the wheel."""
    record = member.build_dir.with_suffix(".json")
    names = [str(path.relative_to(member.folder)) for path in member.files()]
    known = json.loads(record.read_text()) if record.exists() else names
    if set(known) - set(names):
        shutil.rmtree(member.build_dir, ignore_errors=True)
    record.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps(names))


def install_ours(wheels: dict[Member, Path]) -> None:
    """Install the compiled distributions and, editable, RoboXim itself into `.venv`."""
    project = digest(ROOT / "pyproject.toml")
    for member, wheel in wheels.items():
        if not venv.has(member.name, wheel.parent.name):
            with venv.writing(member.name, wheel.parent.name):
                uv_pip(venv, "install", "--offline", "--no-deps", "--reinstall", wheel)
    if not venv.has("project", project) or not (venv.path / "bin" / "roboxim").exists():
        with venv.writing("project", project):
            uv_pip(venv, "install", "--offline", "--no-deps", "--no-build-isolation", "--reinstall", "--editable", ROOT)


def install_gl() -> None:
    """Install the libraries for camera rendering if possible, otherwise print the command that does."""
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
    failed = TOOLS / "no-system-libraries"  # failed: do not retry until `make clean-all`
    may = os.geteuid() == 0 and shutil.which("apt-get") and not os.environ.get("ROBOXIM_NO_APT")
    if may and not failed.exists():
        try:
            with step("system libraries"):
                quiet = {"DEBIAN_FRONTEND": "noninteractive"}
                run("apt-update", "apt-get", "update", extra=quiet)
                run("apt-install", *command.split(), extra=quiet)
            return
        except SetupError as error:
            say(f"  {error}")
            failed.touch()
    say(f"  Without these, cameras may fall back to PyBullet's own renderer. As root: {command}")


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
    """Run every unfinished step."""
    install_uv()
    make_build_environment()  # alone, so that nothing delays the downloads that the longest step waits for
    at_once([install_gl, install_packages, build_members])
    install_ours(build_members())


def at_once(lanes: Sequence[Callable[[], object]]) -> None:
    """Run functions in threads; raise the first error."""
    with ThreadPoolExecutor(len(lanes)) as pool:
        futures = [pool.submit(lane) for lane in lanes]
        wait(futures, return_when=FIRST_EXCEPTION)
        for future in futures:
            future.result()


def interrupt(number: int, frame: object) -> NoReturn:
    """Handle Ctrl-C: running commands receive the signal too, and no further command starts."""
    interrupted.set()
    raise KeyboardInterrupt


def main() -> int:
    """Set up the checkout and print the duration."""
    signal.signal(signal.SIGINT, interrupt)
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
        say("make setup: interrupted; run it again to continue")
        return 130
    finally:
        stop.set()
    seconds = time.monotonic() - started
    say(f"RoboXim is set up ({seconds:.1f} s): .venv/bin/roboxim --help")
    return 0


if __name__ == "__main__":
    sys.exit(main())
