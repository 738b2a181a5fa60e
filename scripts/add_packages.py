"""Add the packages of a lock to the environment in .venv: `add_packages.py NAME` installs `requirements/NAME.lock`.

For optional packages that run together with RoboXim, such as Ray. A later set-up that remakes .venv leaves them out.
"""

from __future__ import annotations

import sys

from environments import LOCKS, ROOT, Environment, packages_key, reported, step, uv_pip


def main(name: str) -> None:
    """Install the packages unless they are there."""
    environment, lock = Environment(ROOT / ".venv"), LOCKS / f"{name}.lock"
    key = packages_key(lock)
    if not environment.has(name, key):
        with step(f"packages for {name}"), environment.writing(name, key):
            uv_pip(environment, "install", "--require-hashes", "--no-deps", "--requirements", lock)


if __name__ == "__main__":
    sys.exit(reported(lambda: main(*sys.argv[1:])))
