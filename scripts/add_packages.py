"""Add the packages of a lock to the environment in .venv: `add_packages.py NAME` installs `requirements/NAME.lock`.

For optional packages that run together with RoboXim, such as Ray. A later set-up that remakes .venv leaves them out.
"""

from __future__ import annotations

import sys
import threading

from environments import LOCKS, ROOT, Environment, SetupError, packages_key, say, show_progress, step, uv_pip


def main(name: str) -> int:
    """Install the packages unless they are there."""
    environment, lock = Environment(ROOT / ".venv"), LOCKS / f"{name}.lock"
    stop = threading.Event()
    threading.Thread(target=show_progress, args=(stop,), daemon=True).start()
    try:
        key = packages_key(lock)
        if not environment.has(name, key):
            with step(f"packages for {name}"), environment.writing(name, key):
                uv_pip(environment, "install", "--require-hashes", "--no-deps", "--requirements", lock)
    except SetupError as error:
        say(str(error))
        return 1
    finally:
        stop.set()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
