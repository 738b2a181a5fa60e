"""Create a separate environment from its lock: `make_environment.py NAME` creates `.tools/NAME-env`.

Separate environments hold packages that conflict with RoboXim's own, such as a second TensorFlow or colcon.
"""

from __future__ import annotations

import sys
import threading

from environments import LOCKS, ROOT, TOOLS, Environment, SetupError, packages_key, run, say, show_progress, step


def main(name: str) -> int:
    """Create the environment unless it exists and is complete."""
    environment, lock = Environment(TOOLS / f"{name}-env"), LOCKS / f"{name}.lock"
    stop = threading.Event()
    threading.Thread(target=show_progress, args=(stop,), daemon=True).start()
    try:
        key = packages_key(lock)
        if not environment.has("packages", key):
            with step(f"environment for {name}"):
                environment.make(lock)
        if "torch==" in lock.read_text() and not environment.has("torch", key):
            with step(f"torch for {name}"), environment.writing("torch", key):
                run(f"{name}-torch", environment.python, ROOT / "scripts" / "torch_on_cpu.py")
    except SetupError as error:
        say(str(error))
        return 1
    finally:
        stop.set()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
