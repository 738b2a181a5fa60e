"""A full disk ends HDF5 files as an error, and not as a segmentation fault."""

from __future__ import annotations

import errno
import subprocess
import sys

import numpy as np
import pytest

from roboxim_datasets.hdf5 import disk

PROGRAM = """
import errno, sys
from pathlib import Path
import numpy as np
from roboxim_datasets.hdf5.disk import new_file
try:
    with new_file(Path(sys.argv[1])) as file:
        for number in range(50):
            file.create_dataset(str(number), data=np.full(100_000, number, np.uint8))
except OSError as error:
    sys.exit(7 if error.errno in (errno.ENOSPC, errno.EFBIG) else 1)
"""


def test_a_limit_of_a_files_size_is_an_error_and_the_process_goes_on(tmp_path):
    limited = f"import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n{PROGRAM}".replace(
        "try:", "resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\ntry:", 1
    )
    done = subprocess.run(
        [sys.executable, "-c", limited, str(tmp_path / "a.hdf5")], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 7, (done.returncode, done.stderr)
    assert done.stderr == ""


@pytest.mark.parametrize("after", [0, 1, 5, 20])
def test_the_first_error_of_the_disk_is_raised_whenever_it_comes(tmp_path, monkeypatch, after):
    class Full(disk._Disk):
        writes = 0

        def write(self, data):
            Full.writes += 1
            if Full.writes > after and self.error is None:
                self.error = OSError(errno.ENOSPC, "No space left on device")
            return super().write(data)

    monkeypatch.setattr(disk, "_Disk", Full)
    Full.writes = 0

    def write():
        with disk.new_file(tmp_path / "a.hdf5") as file:
            for number in range(30):
                group = file.create_group(f"g{number}")
                group.create_dataset("x", data=np.arange(1000.0), chunks=(100,), compression="gzip")
                group.attrs["name"] = "x" * 100

    with pytest.raises(OSError, match="No space left"):
        write()


def test_a_whole_file_is_read_by_the_library(tmp_path):
    import h5py

    with disk.new_file(tmp_path / "a.hdf5") as file:
        file.create_dataset("x", data=np.arange(10))
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["x"][:].tolist() == list(range(10))
