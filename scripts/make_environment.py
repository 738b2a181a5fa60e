"""Make an environment beside the main one from its lock: `make_environment.py NAME` gives `.tools/NAME-env`.

Such an environment holds what must not or cannot live with RoboXim's own packages: a second TensorFlow, a colcon.
"""

from __future__ import annotations

import sys
import threading

from environments import LOCKS, TOOLS, Environment, SetupError, packages_key, say, show_progress, step


def main(name: str) -> int:
    """Make the environment unless it is there and whole."""
    environment, lock = Environment(TOOLS / f"{name}-env"), LOCKS / f"{name}.lock"
    stop = threading.Event()
    threading.Thread(target=show_progress, args=(stop,), daemon=True).start()
    try:
        if not environment.has("packages", packages_key(lock)):
            with step(f"environment for {name}"):
                environment.make(lock)
    except SetupError as error:
        say(str(error))
        return 1
    finally:
        stop.set()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
