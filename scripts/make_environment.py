"""Create a separate environment from its lock: `make_environment.py NAME` creates `.tools/NAME-env`.

Separate environments hold packages that conflict with RoboXim's own, such as a second TensorFlow or colcon.
"""

from __future__ import annotations

import sys

from environments import LOCKS, ROOT, TOOLS, Environment, packages_key, reported, run, step


def main(name: str) -> None:
    """Create the environment unless it exists and is complete."""
    environment, lock = Environment(TOOLS / f"{name}-env"), LOCKS / f"{name}.lock"
    key = packages_key(lock)
    if not environment.has("packages", key):
        with step(f"environment for {name}"):
            environment.make(lock)
    if "torch==" in lock.read_text() and not environment.has("torch", key):
        with step(f"torch for {name}"), environment.writing("torch", key):
            run(f"{name}-torch", environment.python, ROOT / "scripts" / "torch_on_cpu.py")


if __name__ == "__main__":
    sys.exit(reported(lambda: main(*sys.argv[1:])))
