"""Planners to compare, each in a process with its own environment, queried one after the other.

A contender is a script in ``peers/`` that implements the protocol of ``peers/_serve.py``. Peers get the same robot: the
planner's URDF and SRDF with the collision meshes replaced by their convex hulls, which RoboXim's planner uses as well.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from benchmarks.peers._serve import unpack
from benchmarks.planner._machines import SOURCE
from benchmarks.planner._problems import Problem
from benchmarks.planner._referee import Verdict

Array = npt.NDArray[np.float64]
HERE = Path(__file__).resolve().parents[1]
TOOLS = HERE.parent / ".tools"
OURS = "roboxim"
LIMIT_S = 5.0
"""Time limit for a problem."""
_FOREIGN = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A contender's result for a problem."""

    problem: str
    """Its name."""
    contender: str
    """Who."""
    ms: float
    """Time of the request; RoboXim's includes the scene's set-up, a peer's does not."""
    scene_ms: float = 0.0
    """Time of a peer's scene set-up; 0: it is part of ``ms``."""
    error: str = ""
    """Reason why there is no motion; empty if there is one."""
    faults: str = ""
    """Reason why the motion is invalid; empty if it is valid."""
    violations: str = ""
    """Limits that the motion violates."""
    duration_s: float = 0.0
    """Duration of the motion."""
    toppra_s: float = 0.0
    """Shortest duration that toppra finds on the motion's path; 0: not measured."""
    route: str = ""
    """How the motion was found, if the contender reports it."""
    detour: bool = False
    """Whether the direct joint line collides."""
    positions: Array | None = field(default=None, compare=False, repr=False)
    """The motion at a kilohertz, shape (N, dof) [rad]; not stored."""

    @property
    def valid(self) -> bool:
        """Whether there is a collision-free motion from the start to the goal."""
        return not self.error and not self.faults

    @property
    def clean(self) -> bool:
        """Whether the motion also satisfies all limits."""
        return self.valid and not self.violations


class Contender:
    """A planner in a separate process."""

    def __init__(self, name: str, python: Path, script: str, *arguments: str) -> None:
        """Describe the process; it starts with the first request."""
        self.name = name
        self._command = [str(python), str(HERE / "peers" / script), *arguments]
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Contender:
        """Return itself; leaving ends the process."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self.stop()

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def start(self) -> None:
        """Start the process and wait until it is ready.

        Raises:
            RuntimeError: When it does not start; the message contains its last output.
        """
        environment = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
        if environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None):
            environment.pop("LD_LIBRARY_PATH", None)
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115 (lives as long as the process)
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, text=True, env=environment
        )
        if self._answer(120.0) is None:
            raise RuntimeError(f"{self.name} does not start: {self._last_words()}")

    def ask(self, request: dict[str, Any], limit_s: float = 60.0) -> dict[str, Any]:
        """Send a request and return the response; a hang and death by a signal give a response with an error.

        Raises:
            RuntimeError: When the process exits by itself, which is a fault of the script in ``peers/``.
        """
        if self._process is None:
            self.start()
        assert self._process is not None
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            answer = self._answer(limit_s)
        except BrokenPipeError:
            answer = None
        if answer is None:
            try:
                code = self._process.wait(1.0)
            except subprocess.TimeoutExpired:
                code = 0
            self.stop()
            if code > 0:
                raise RuntimeError(f"{self.name} ended: {self._last_words()}")
            return {"ms": 1e3 * limit_s, "error": f"died of signal {-code}" if code else "hung"}
        return answer

    def solve(self, problem: Problem, seed: int) -> Outcome:
        """Let the contender solve a problem and judge the result."""
        answer = self.ask({"problem": problem.plain(), "seed": seed, "limit_s": LIMIT_S}, 6.0 * LIMIT_S)
        common: dict[str, Any] = {"problem": problem.name, "contender": self.name, "detour": problem.detour}
        common["scene_ms"] = answer.get("setup_ms", 0.0)
        if answer["error"]:
            return Outcome(**common, ms=answer["ms"], error=answer["error"])
        positions = unpack(answer["positions"])
        verdict: Verdict = problem.referee().judge(
            positions, answer["duration_s"], np.array(problem.start), problem.goal_value
        )
        return Outcome(
            **common,
            ms=answer["ms"],
            faults="; ".join(verdict.faults),
            violations="; ".join(verdict.violations),
            duration_s=answer["duration_s"],
            route=answer.get("route", ""),
            positions=positions,
        )

    def _last_words(self) -> str:
        self._log.seek(0)
        return self._log.read()[-2000:]

    def _answer(self, limit_s: float) -> dict[str, Any] | None:
        assert self._process is not None
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], limit_s)
        line = self._process.stdout.readline() if ready else ""
        return json.loads(line) if line else None


def contenders(names: list[str], robot_folder: Path, robot: str = "panda") -> tuple[list[Contender], list[str]]:
    """Return the contenders that are installed, and the names of those that are not.

    Args:
        names: Of ``roboxim``, ``mplib``, ``roboplan``.
        robot_folder: An empty folder for the peers' robot, the Panda.
        robot: Of RoboXim's planner.
    """
    write_robot(robot_folder)
    found, missing = [], []
    for name in names:
        python = Path(sys.executable) if name == OURS else TOOLS / f"planner-{name}-env/bin/python"
        arguments = [robot if name == OURS else str(robot_folder)]
        if python.exists():
            found.append(Contender(name, python, f"run_{name}.py", *arguments))
        else:
            missing.append(name)
    return found, missing


def our_planner() -> Contender:
    """Return RoboXim's planner for the Panda, in a separate process."""
    return Contender(OURS, Path(sys.executable), "run_roboxim.py")


def toppra_measure() -> Contender | None:
    """Return toppra, or none if its environment is not installed."""
    python = TOOLS / "planner-mplib-env/bin/python"
    return Contender("toppra", python, "run_toppra.py") if python.exists() else None


def write_robot(folder: Path) -> None:
    """Write the URDF, with convex collision meshes (``package://panda/...``) and no visual meshes, and the SRDF."""
    tree = ElementTree.parse(SOURCE / "urdf/panda.urdf")
    (folder / "panda").mkdir()
    for link in tree.getroot().iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for mesh in link.iter("mesh"):
            name = Path(mesh.attrib["filename"]).name
            hull = trimesh.load_mesh(SOURCE / "meshes/collision" / name).convex_hull
            for file in (name, f"{name}.convex.stl"):  # mplib looks for the second one
                hull.export(folder / "panda" / file)
            mesh.set("filename", f"package://panda/{name}")
    tree.write(folder / "panda.urdf")
    (folder / "panda.srdf").write_bytes((SOURCE / "srdf/panda.srdf").read_bytes())
