"""The checks of `roboxim doctor`. Each check is one function; none changes anything."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from roboxim_core.errors import RoboximError
from roboxim_core.plain_data.extras import EXTRAS, PURPOSES, absent, install_command
from roboxim_core.registry import Registry
from roboxim_core.user_folders import user_name

GIB = 2**30
MIB = 2**20
WHEELS = ("ros-jazzy-rclpy", "ros-fastrtps", "ros-jazzy-sensor-msgs")
OLDEST_PYTHON, NEWEST_PYTHON = (3, 11), (3, 13)
PYBULLET = "pybullet" if sys.version_info < (3, 12) else "pybullet-arm64"
"""Distribution that brings PyBullet: its maintained fork where PyBullet itself has no wheel."""
LIBRARIES = (
    "numpy", PYBULLET, "pin", "ompl", "ruckig", "moderngl", "opencv-python-headless", "mcap", "rosbags",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Result of one check."""

    name: str
    """Subject of the check."""
    state: str
    """``ok``, ``warning`` (a part works with limits or fails), ``missing`` (RoboXim does not work), or ``absent`` (an
    optional part is not installed)."""
    detail: str
    """The finding, in words."""
    remedy: str = ""
    """What to do."""
    without: str = ""
    """Effect of the finding: which parts work or do not."""
    purpose: str = ""
    """Purpose of an optional part."""


def examine() -> Iterator[Finding]:
    """Check this machine; yield each finding as soon as it is available.

    The renderers are tested in other processes, meanwhile.
    """
    with ThreadPoolExecutor(max_workers=len(PROBES)) as pool:
        probes = [pool.submit(_finding, check) for check in PROBES]
        yield from map(_finding, CHECKS)
        yield from (probe.result() for probe in probes)


def _rated(name: str, good: bool, detail: str, otherwise: str = "warning", **more: str) -> Finding:
    """Return the finding of a check with a yes-or-no result.

    Args:
        name: Subject of the check.
        good: Whether the check passed.
        detail: The finding, in words.
        otherwise: State of the finding if the check failed.
        **more: ``remedy``, ``without`` and ``purpose`` of the finding.
    """
    return Finding(name=name, state="ok" if good else otherwise, detail=detail, **more)


def _finding(check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except Exception as error:  # a broken check must not hide the others
        return Finding(
            name=check.__name__.strip("_").replace("_", " "),
            state="missing" if check in REQUIRED else "warning",
            detail=f"{type(error).__name__}: {error}",
        )


def _python() -> Finding:
    version = ".".join(map(str, sys.version_info[:3]))
    return _rated(
        "Python", OLDEST_PYTHON <= sys.version_info[:2] <= NEWEST_PYTHON, f"{version} ({sys.executable})", "missing",
        remedy="install RoboXim with Python 3.11, 3.12 or 3.13; in a checkout: make setup PYTHON=/path/to/python3.12",
        without="the wheels of ROS 2 Jazzy and PyBullet exist for these only",
    )  # fmt: skip


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _packages(name: str, packages: tuple[str, ...]) -> Finding:
    versions = {package: _version(package) for package in packages}
    absent = [package for package, version in versions.items() if version is None]
    detail = ", ".join(f"{name.removeprefix('ros-jazzy-')} {version or '-'}" for name, version in versions.items())
    without = f"nothing that needs {', '.join(absent)}"
    return _rated(name, not absent, detail, "missing", remedy="make setup", without=without)


def _ros_wheels() -> Finding:
    import rclpy

    if _version("ros-jazzy-rclpy") is None:  # built with colcon on an installed ROS 2
        detail = f"{os.environ.get('ROS_DISTRO', 'of an unknown distribution')}, {Path(rclpy.__file__).parent}"
        return _rated("ROS 2", True, detail)
    return _packages("ROS 2 wheels", WHEELS)


def _libraries() -> Finding:
    return _packages("libraries", LIBRARIES)


def _extras() -> Finding:
    missing = {extra: modules for extra in EXTRAS if (modules := absent(extra))}
    return Finding(
        name="extras",
        state="absent" if missing else "ok",
        detail=f"installed: {', '.join(extra for extra in EXTRAS if extra not in missing) or 'none'}"
        + (f"; not installed: {', '.join(missing)}" if missing else ""),
        remedy=install_command(",".join(missing)),
        purpose="; ".join(f"{extra}: {PURPOSES[extra]}" for extra in missing),
    )


def _interfaces() -> Finding:
    try:
        from roboxim_interfaces.srv import Tick

        detail = f"built ({len(Tick.Request.get_fields_and_field_types())} fields in srv/Tick)"
        return _rated("interfaces", True, detail)
    except ImportError as error:
        without = "no node can start"
        return _rated("interfaces", False, str(error), "missing", remedy="make setup", without=without)


def _compiler() -> Finding:
    compiler = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc") or shutil.which("clang")
    header = Path(sysconfig.get_paths()["include"], "Python.h")
    detail = f"{compiler or 'no C compiler'}, {header if header.is_file() else 'no Python.h'}"
    return _rated(
        "compiler", bool(compiler) and header.is_file(), detail, remedy="apt install build-essential python3-dev",
        without="everything works until an interface file changes",
    )  # fmt: skip


OPTIONAL_RENDERERS = {"photo"}
"""The renderer ``photo`` is optional and has its own check."""


def _plugins() -> Finding:
    from roboxim_core.recorded import RECORDED_PARAMETERS
    from roboxim_policies.base import POLICIES
    from roboxim_sim.rendering import RENDERERS
    from roboxim_tasks.components import COMPONENTS
    from roboxim_tasks.skills import SKILLS

    importlib.import_module("roboxim_policies.builtin")  # registers the policies of RoboXim
    registries: tuple[Registry[Any], ...] = (SKILLS, COMPONENTS, POLICIES, RENDERERS, RECORDED_PARAMETERS)
    broken = [f"{r.kind} '{name}': {what}" for r in registries for name, what in r.broken.items()]
    counts = ", ".join(f"{len(r)} of kind {r.kind}" for r in registries)
    remedy = "repair or uninstall the distributions that they come from"
    return _rated("plug-ins", not broken, "; ".join(broken) or counts, remedy=remedy, without="everything else works")


def _renderers() -> Finding:
    from roboxim_sim.rendering import RENDERERS, available_renderers

    found = available_renderers(name for name in RENDERERS if name not in OPTIONAL_RENDERERS)
    detail = "; ".join(f"{name}: {status.detail}" for name, status in found.items())
    absent = [name for name, status in found.items() if not status.available]
    return _rated(
        "renderers", not absent, detail, "missing" if len(absent) == len(found) else "warning",
        remedy="on Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri",
        without="use -p sim:renderer:=tiny -p tasks:visible_renderer:=tiny: PyBullet's own, slower and plainer",
    )  # fmt: skip


def _photo() -> Finding:
    from roboxim_sim.rendering import available_renderers

    status = available_renderers(["photo"])["photo"]
    purpose = "rendering recorded episodes again with Blender (roboxim rerender --renderer photo)"
    return _rated(
        "renderer photo", status.available, status.detail, "absent", remedy="make photo", purpose=purpose
    )  # fmt: skip


def _verify_rlds() -> Finding:
    """Check the optional environment of ``make verify-rlds``."""
    folder = Path(sys.prefix).parent / ".tools" / "verify-rlds-env"
    there = folder.is_dir()
    return _rated(
        "verify-rlds", there, str(folder) if there else "not installed", "absent",
        remedy="make verify-rlds DATASET=...", purpose="reading an exported dataset with TensorFlow Datasets",
    )  # fmt: skip


def _shared_memory() -> Finding:
    from roboxim_ros.shared_memory import FOLDER, NEEDED_BYTES, fault_of_folder

    fault = fault_of_folder()
    if fault is not None:
        return _rated("shared memory", False, fault, "missing", without="no graph can start")
    usage = shutil.disk_usage(FOLDER)
    left = sum(1 for _ in FOLDER.glob("fastrtps_*"))
    detail = f"{usage.free / MIB:.1f} MiB of {usage.total / MIB:.1f} MiB free, {left} files of Fast DDS"
    return _rated(
        "shared memory", usage.free >= 32 * MIB, detail,
        remedy="with no ROS process alive: fastdds shm clean; in Docker: --shm-size=512m",
        without=f"at most {usage.free // NEEDED_BYTES} processes with nodes can run at a time",
    )  # fmt: skip


def _terminal() -> Finding:
    """Report settings of another ROS that are ignored in this terminal; see `roboxim_ros.environment`."""
    from roboxim_ros.environment import LEFT_OUT, set_log_folder

    set_log_folder()
    left_out = os.environ.get(LEFT_OUT, "").split(os.pathsep)
    others = f"another ROS is left out: {', '.join(left_out)}" if any(left_out) else "no other ROS in it"
    logs = os.environ.get("ROS_LOG_DIR")
    return _rated("terminal", True, others + (f"; logs of ROS in {logs}" if logs else ""))


def _graph() -> Finding:
    """Call a service between two contexts, as between two processes."""
    from std_srvs.srv import Empty

    from roboxim_ros.clients import Clients
    from roboxim_ros.guard import GuardedNode
    from roboxim_ros.host import NodeHost
    from roboxim_ros.runs import free_domain

    def probe(context: Any) -> GuardedNode:
        node = GuardedNode("doctor", context=context)
        node.create_service(Empty, "probe", lambda request, response: response)
        return node

    started = time.monotonic()
    try:
        with (
            free_domain() as domain,
            NodeHost(domain_id=domain) as server,
            NodeHost(domain_id=domain) as client,
            Clients("doctor_client", context=client.context) as clients,
        ):
            server.add(probe)
            clients.call(Empty, "probe", Empty.Request(), timeout_s=60)
    except RoboximError as error:
        remedy = "see the message; in a container, share /dev/shm with the other processes (--ipc)"
        without = "nodes do not discover each other"
        return _rated("graph", False, str(error), "missing", remedy=remedy, without=without)
    return _rated("graph", True, f"first answer after {time.monotonic() - started:.2f} s")


def _network() -> Finding:
    name, remedy = "who can reach a graph", "unset ROBOXIM_TRANSPORT"
    if os.environ.get("ROBOXIM_TRANSPORT") == "network":
        detail = "every host and user that reaches this machine can call every service and read every topic"
        return _rated(name, False, detail, remedy=remedy)
    detail = f"processes of user {user_name()} on this machine, and its superuser; no other user, no other host"
    return _rated(name, True, detail)


def _cores() -> Finding:
    cores = len(os.sched_getaffinity(0))
    detail = f"{cores} usable; a good --workers is {max(1, cores)}"
    return _rated("cores", cores >= 2, detail, without="everything works, at half the speed")


def _memory() -> Finding:
    lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    free = int(lines["MemAvailable"].split()[0]) * 1024
    detail = f"{free / GIB:.1f} GiB available; a worker needs about 0.5 GiB"
    return _rated("memory", free > 2 * GIB, detail, remedy="use fewer workers")


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    detail = f"{free / GIB:.1f} GiB free in {Path.cwd()}"
    remedy, without = "free some space, or write elsewhere with --out", "long recordings end with the error DISK"
    return _rated("disk", free > 2 * GIB, detail, remedy=remedy, without=without)


def _runs() -> Finding:
    from roboxim_ros.runs import live_runs, runtime_dir

    runs = live_runs()
    return _rated("runs", True, f"{len(runs)} alive; registered in {runtime_dir()}")


CHECKS: tuple[Callable[[], Finding], ...] = (
    _python,
    _ros_wheels,
    _interfaces,
    _libraries,
    _extras,
    _compiler,
    _verify_rlds,
    _terminal,
    _shared_memory,
    _network,
    _cores,
    _memory,
    _disk,
    _runs,
    _plugins,
    _graph,
)
"""The quick checks come first."""
PROBES: tuple[Callable[[], Finding], ...] = (_renderers, _photo)
"""Checks that wait for other processes."""
REQUIRED = (_python, _ros_wheels, _interfaces, _libraries, _terminal, _shared_memory, _graph, _renderers)
"""Checks of parts without which RoboXim does not work."""
