"""Try RoboXim from its sources in environments of other Pythons, or with the lowest versions that its metadata allow.

    python scripts/try_pythons.py 3.12 3.13      # installs each Python if it is missing: make test-pythons
    python scripts/try_pythons.py 3.11 --lowest  # the lowest versions of what pyproject.toml names: make test-lowest

Each environment is `.tools/try-PYTHON-env` and stays until what it is made of changes, so the next call is quick. In it
run the golden hashes (`tests/test_golden.py`) and ``roboxim demo --smoke``; with ``--lowest``, whose versions may draw
other pictures, the smoke demo alone.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import threading
from pathlib import Path

from environments import (
    LOCKS,
    ROOT,
    TOOLS,
    UV,
    Environment,
    SetupError,
    digest,
    index_settings,
    run,
    say,
    show_progress,
    step,
    uv_pip,
)
from release import compiled_wheels, interpreter

EXTRAS = ("learn", "lerobot")
TESTS = ("pytest", "pytest-timeout", "hypothesis")


def python(version: str) -> str:
    """Return the path of a Python; uv installs it if there is none.

    Raises:
        SetupError: It cannot be installed.
    """
    try:
        return interpreter(version)
    except SetupError:
        run(f"python-{version}", UV, "python", "install", version)
        return interpreter(version)


def make(version: str, lowest: bool) -> Environment:
    """Return the environment of a Python, installed unless nothing has changed."""
    base = python(version)
    lock = LOCKS / "dev.lock"
    environment = Environment(TOOLS / f"try-{version}{'-lowest' if lowest else ''}-env", base)
    wheels = compiled_wheels(version)
    key = digest(ROOT / "pyproject.toml", lock, base, *(wheel.name for wheel in wheels), str(ROOT))
    if not environment.has("packages", key):
        run(f"try-{version}-create", UV, "venv", "--quiet", "--clear", "--python", base, environment.path)
        (environment.path / ".roboxim").mkdir()
        with environment.writing("packages", key), tempfile.TemporaryDirectory() as folder:
            exact = Path(folder) / "exact.txt"
            exact.write_text(re.sub(r" *\\\n +--hash=\S+", "", lock.read_text()))
            how = ("--resolution", "lowest-direct") if lowest else ("--constraints", exact)
            extras = (part for extra in EXTRAS for part in ("--extra", extra))
            tests = () if lowest else TESTS
            uv_pip(
                environment, "install", "--no-sources", *how, "--requirements", ROOT / "pyproject.toml",
                *extras, *wheels, *tests,
            )  # fmt: skip
    uv_pip(environment, "install", "--no-deps", "--reinstall-package", "roboxim", ROOT)
    return environment


def main() -> int:
    """Make the environments, and run the tests in each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("versions", nargs="+", metavar="PYTHON", help="e.g. 3.12")
    parser.add_argument("--lowest", action="store_true", help="the lowest versions of the direct dependencies")
    options = parser.parse_args()
    threading.Thread(target=show_progress, args=(threading.Event(),), daemon=True).start()
    try:
        for version in options.versions:
            with step(f"Python {version}: install"):
                environment = make(version, options.lowest)
            paths = {"PATH": f"{environment.path / 'bin'}:/usr/local/bin:/usr/bin:/bin", **index_settings()}
            if not options.lowest:
                with step(f"Python {version}: golden hashes"):
                    arguments = ("-q", "-p", "no:cacheprovider", "-m", "not slow", "tests/test_golden.py")
                    run(f"try-{version}-golden", environment.python, "-m", "pytest", *arguments, extra=paths)
            with step(f"Python {version}: smoke demo"), tempfile.TemporaryDirectory() as folder:
                demo = ("demo", "--smoke", "--out", Path(folder) / "demo")
                run(f"try-{version}-demo", environment.path / "bin" / "roboxim", *demo, extra=paths)
    except SetupError as error:
        say(str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
