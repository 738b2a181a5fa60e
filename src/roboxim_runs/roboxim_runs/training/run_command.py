"""Runs a command that dies with its parent: ``python -m roboxim_runs.training.run_command PROGRAM [ARGUMENT ...]``.

The kernel's request to kill this process with its parent outlives `exec`, so any program can be such a child.
"""

from __future__ import annotations

import os
import signal
import sys

from roboxim_bringup.process import die_with_parent


def main() -> None:
    """Become the command, which SIGINT interrupts even where a shell's background job ignores it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # becomes the default action in the command
    die_with_parent(int(os.environ.pop("ROBOXIM_PARENT")))  # a script's own roboxim commands have another parent
    program, *_ = words = sys.argv[1:]
    os.execvp(program, words)


if __name__ == "__main__":
    main()
