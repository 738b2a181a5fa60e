"""Command lines that are printed for people."""

from __future__ import annotations

import shlex


def shell_line(*words: object) -> str:
    """Return words as a command line, each as text, and quoted where a shell needs it."""
    return shlex.join(map(str, words))
