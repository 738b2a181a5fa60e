"""Settings of a process."""

import platform
import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys
import numpy as np
from roboxim_bringup.process import keep_freed_memory

if sys.argv[1] == "keep":
    assert keep_freed_memory()
np.ones(1 << 26, np.uint8)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    np.ones(1 << 25, np.uint8)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
"""Allocates and frees 32 MiB 20 times, and prints its page faults meanwhile."""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no such settings")
def test_freed_memory_is_used_again_without_asking_the_kernel():
    def page_faults(setting: str) -> int:
        found = subprocess.run(
            [sys.executable, "-c", PROGRAM, setting], capture_output=True, text=True, check=True, timeout=60
        )
        return int(found.stdout)

    assert page_faults("keep") < 100 < page_faults("default")
