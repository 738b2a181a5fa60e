"""The environment of RoboXim's processes, without the parts that belong to another ROS.

A terminal in which a ROS 2 is sourced has the ``PYTHONPATH`` and ``LD_LIBRARY_PATH`` of that ROS, whose ``rclpy`` is
for another Python. RoboXim's environment has ROS as wheels, so both are left out of its processes. An installation that
was built with colcon has no wheels and is left unchanged.

This module imports neither `rclpy` nor anything that another ROS could bring.

Non-obvious:
- ``LD_LIBRARY_PATH`` is read when a program starts. A program therefore starts itself again without the other ROS
  (`start_clean`); a script that imports RoboXim only gets an error (`clean_environment`).
- The wheels put their own folders into ``LD_LIBRARY_PATH`` in no fixed order, so another ROS is found first only
  sometimes.
"""

from __future__ import annotations

import os
import re
import sys
import sysconfig
from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_core.user_folders import can_write, home_dir, runtime_dir

LEFT_OUT = "ROBOXIM_LEFT_OUT"
"""Environment variable with the folders that were left out, for ``roboxim doctor``."""


def start_clean() -> None:
    """Leave another ROS out of this program; restart the program if that ROS's libraries may already be loaded."""
    foreign = _foreign_libraries()
    _leave_out("PYTHONPATH", _foreign_packages())
    if foreign:
        _leave_out("LD_LIBRARY_PATH", foreign)
        os.execv(sys.executable, sys.orig_argv)


def clean_environment() -> None:
    """Leave another ROS out of this process and its children, and set a folder for the logs of ROS.

    Raises:
        ConfigError: When another ROS's libraries come first, or no folder for logs can be written.
    """
    foreign = _foreign_libraries()
    folders = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    own = next((i for i, folder in enumerate(folders) if _is_own(Path(folder))), len(folders))
    if foreign and folders.index(foreign[0]) < own:
        raise ConfigError(
            f"LD_LIBRARY_PATH names {foreign[0]}, which has the libraries of another ROS; start Python "
            "from a terminal without it: env -u LD_LIBRARY_PATH -u PYTHONPATH python ..."
        )
    _leave_out("LD_LIBRARY_PATH", foreign)
    _leave_out("PYTHONPATH", _foreign_packages())
    set_log_folder()


def set_log_folder() -> None:
    """Set ``ROS_LOG_DIR`` when ROS's own folder for logs, ``~/.ros/log``, cannot be written.

    Raises:
        ConfigError: When the environment names a folder that cannot be written.
    """
    given = os.environ.get("ROS_LOG_DIR")
    if given and not can_write(Path(given).absolute()):
        raise ConfigError(
            f"ROS_LOG_DIR names {given}, which cannot be written; name another folder, or unset it: "
            "without it, a folder that can be written is chosen"
        )
    if given:
        return
    ros_home, home = os.environ.get("ROS_HOME"), home_dir()
    folder = Path(ros_home) if ros_home else home / ".ros" if home is not None else None
    known = ros_home or os.environ.get("HOME")  # rcl does not read the password database
    if folder is None or not known or not can_write(folder.absolute() / "log"):
        os.environ["ROS_LOG_DIR"] = str(runtime_dir() / "log")


def _leave_out(name: str, foreign: list[str]) -> None:
    """Take folders out of a variable of the environment, and out of this process's module search path."""
    if not foreign:
        return
    kept = [folder for folder in os.environ[name].split(os.pathsep) if folder not in foreign]
    if any(kept):
        os.environ[name] = os.pathsep.join(kept)
    else:
        del os.environ[name]
    if name == "PYTHONPATH":
        gone = {os.path.abspath(folder) for folder in foreign}
        sys.path[:] = [folder for folder in sys.path if os.path.abspath(folder) not in gone]
    before = os.environ.get(LEFT_OUT, "").split(os.pathsep)
    os.environ[LEFT_OUT] = os.pathsep.join(dict.fromkeys(filter(None, [*before, *foreign])))


def _has_wheels() -> bool:
    return Path(sysconfig.get_path("purelib"), "rclpy").is_dir()


def _is_own(folder: Path) -> bool:
    return folder.absolute().is_relative_to(sys.prefix)


def _foreign_packages() -> list[str]:
    """Return the folders of ``PYTHONPATH`` that are of another Python, or have an `rclpy`."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    found = []
    for folder in filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)) if _has_wheels() else ():
        other = re.search(r"[/\\]python(\d+(?:\.\d+)?)[/\\](?:site|dist)-packages", folder)
        if not _is_own(Path(folder)) and ((other and other[1] != version) or Path(folder, "rclpy").is_dir()):
            found.append(folder)
    return found


def _foreign_libraries() -> list[str]:
    """Return the folders of ``LD_LIBRARY_PATH`` that have libraries of another ROS."""
    folders = filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)) if _has_wheels() else ()
    return [
        folder
        for folder in folders
        if not _is_own(Path(folder)) and any(Path(folder, name).exists() for name in ("librcl.so", "librcutils.so"))
    ]
