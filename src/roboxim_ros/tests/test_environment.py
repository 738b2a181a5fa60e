"""Terminals and containers whose environment belongs to another ROS, or has no home."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import namedtuple

import pytest

from roboxim_core import user_folders
from roboxim_core.errors import ConfigError
from roboxim_ros import environment, shared_memory
from roboxim_ros.testing import PATIENCE_S

PROGRAM = """
from roboxim_ros.environment import start_clean
start_clean()
import os, rclpy
from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain
with free_domain() as domain, NodeHost(domain_id=domain):
    print(rclpy.__file__, os.environ.get("ROBOXIM_LEFT_OUT"), os.environ["ROS_LOG_DIR"], sep="\\n")
"""


@pytest.fixture
def sourced(tmp_path):
    """Return the environment of a terminal with a ROS of Python 3.12, whose libraries cannot be loaded."""
    packages, libraries = tmp_path / "ros/lib/python3.12/site-packages", tmp_path / "ros/lib"
    (packages / "rclpy").mkdir(parents=True)
    (packages / "rclpy/__init__.py").write_text("from rclpy._rclpy_pybind11 import Context\n")
    (libraries / "librcl.so").write_text("not a library")
    (libraries / "librcutils.so").write_text("not a library")
    return {"PYTHONPATH": str(packages), "LD_LIBRARY_PATH": str(libraries), "ROS_DISTRO": "jazzy"}


@pytest.mark.ros
def test_a_program_runs_in_a_terminal_of_another_ros_and_without_a_home(sourced, tmp_path):
    left = {key: value for key, value in os.environ.items() if key not in ("ROS_LOG_DIR", "ROS_HOME")}
    libraries = os.pathsep.join([sourced["LD_LIBRARY_PATH"], os.environ.get("LD_LIBRARY_PATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=PATIENCE_S,
        env={**left, **sourced, "LD_LIBRARY_PATH": libraries, "HOME": "/dev/null", "TMPDIR": str(tmp_path),
             "XDG_RUNTIME_DIR": ""},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    imported, left_out, logs = done.stdout.splitlines()
    assert imported.startswith(sys.prefix)
    assert set(left_out.split(os.pathsep)) == {sourced["PYTHONPATH"], sourced["LD_LIBRARY_PATH"]}
    assert logs == str(tmp_path / f"roboxim-{os.getuid()}" / "log")


def test_only_what_belongs_to_another_ros_is_left_out(sourced, tmp_path, monkeypatch):
    own = tmp_path / "my_plugins"
    own.mkdir()
    places = [str(own), sourced["PYTHONPATH"], "/usr/lib/python3/dist-packages"]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(places))
    monkeypatch.setenv("LD_LIBRARY_PATH", os.pathsep.join([f"{sys.prefix}/lib", sourced["LD_LIBRARY_PATH"]]))
    monkeypatch.setattr(sys, "path", [*sys.path, *places])
    environment.clean_environment()
    assert os.environ["PYTHONPATH"] == str(own)
    assert os.environ["LD_LIBRARY_PATH"] == f"{sys.prefix}/lib"
    assert str(own) in sys.path
    assert not set(places[1:]) & set(sys.path)


def test_a_script_with_the_libraries_of_another_ros_is_told_what_to_do(sourced, monkeypatch):
    monkeypatch.setenv("LD_LIBRARY_PATH", sourced["LD_LIBRARY_PATH"])
    with pytest.raises(ConfigError, match="libraries of another ROS.*env -u LD_LIBRARY_PATH"):
        environment.clean_environment()


def test_a_log_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "file/log"))
    with pytest.raises(ConfigError, match="ROS_LOG_DIR names .*file/log, which cannot be written"):
        environment.set_log_folder()


def test_the_log_folder_of_a_home_that_can_be_written_is_left_to_ros(tmp_path, monkeypatch):
    monkeypatch.delenv("ROS_LOG_DIR", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    environment.set_log_folder()
    assert "ROS_LOG_DIR" not in os.environ


def test_a_user_without_home_has_a_cache_and_no_tilde(tmp_path, monkeypatch):
    monkeypatch.setattr(user_folders, "home_dir", lambda: None)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert user_folders.cache_dir() == tmp_path / "roboxim" / "cache"
    with pytest.raises(ConfigError, match=r"the home \(~\) is not known; set HOME"):
        user_folders.expanded("~no_such_user/x")


def test_shared_memory_that_is_too_small_or_absent_is_named(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shared_memory.shutil, "disk_usage", lambda _: usage(300 * 1024, 0, 290 * 1024))
    assert "290 of 300 KiB free" in shared_memory.fault_of_folder()
    monkeypatch.setattr(shared_memory, "FOLDER", tmp_path / "absent")
    assert "cannot be written" in shared_memory.fault_of_folder()
