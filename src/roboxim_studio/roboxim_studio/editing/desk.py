"""The edited document with its checks and its simulated start, kept in step. Knows no page."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.kinematics import ArmKinematics, Arms
from roboxim_core.limits import is_file_name
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_studio.bench import Bench
from roboxim_studio.editing.document import History, as_yaml, checked, scene_hash
from roboxim_studio.own_files import OwnFiles
from roboxim_tasks.demonstration.solvable import state_at_rest
from roboxim_tasks.fixed_scene import FixedTask, FixedTaskConfig

if TYPE_CHECKING:
    from roboxim_studio.acting.lab import Lab
    from roboxim_tasks.sampling.scene_check import Finding

SEED = SeedPath(run_seed=0, purpose="demo", index=0)
"""Seed path that checks use: the planner's detours depend on it."""
Picture = npt.NDArray[np.uint8]
Points = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Checks:
    """What the checks say of a document."""

    of: FixedTask
    """The document."""
    findings: tuple[Finding, ...] = ()
    """Violated constraints."""
    error: str = ""
    """Why the document is not a task; empty: it is one."""
    whole: bool = False
    """Whether the checks that need cameras and the planner have run; they are not while a quick check refuses the
    scene."""

    @property
    def valid(self) -> bool:
        """Whether everything was checked and nothing was found."""
        return self.whole and not self.findings and not self.error

    @property
    def unfinished(self) -> bool:
        """Whether nothing has been found so far, and checks are still to come."""
        return not (self.whole or self.findings or self.error)

    @property
    def text(self) -> str:
        """The findings, one a line."""
        if self.error:
            return self.error
        lines = [f"{f.constraint}: {f.message}" for f in self.findings]
        return "\n".join(lines) or ("checking ..." if self.unfinished else "valid: every constraint of the task holds")


class Desk:
    """A document, its history and its checks. Edits may come from any thread; checks run on the bench."""

    def __init__(self, document: FixedTask, library: ModelLibrary, bench: Bench, lab: Lab) -> None:
        """Edit a document."""
        self.history = History(document)
        self._library, self._bench, self._lab = library, bench, lab
        self._arms = Arms(library)
        self.own_files = OwnFiles()
        """Files that saving may replace."""
        self.lock = threading.RLock()
        """Held while the document changes."""
        self.checks = Checks(of=document)
        """The newest checks."""
        self.on_change: list[Callable[[], None]] = []
        """Called after every change of the document."""
        self.on_checks: list[Callable[[], None]] = []
        """Called when checks have come."""
        self.on_plan: list[Callable[[Points], None]] = []
        """Called with the way of the tool in the expert's plan, when a document is valid."""
        self.on_pictures: list[Callable[[Mapping[str, Picture]], None]] = []
        """Called with the cameras' pictures of the document."""

    @property
    def document(self) -> FixedTask:
        """The document."""
        return self.history.now

    @property
    def scene(self) -> SceneSpec:
        """Its scene."""
        return self.history.now.fixed.scene

    def state(self, scene: SceneSpec | None = None) -> StateRecord:
        """Return the start of a scene, as if nothing moved while it settles.

        Args:
            scene: The scene; none: the document's.
        """
        scene = scene or self.scene
        return start_of(scene, self._arms[scene.robot.model])

    def arm(self) -> ArmKinematics:
        """Return the kinematics of the document's robot."""
        return self._arms[self.scene.robot.model]

    def edit(self, change: Callable[[FixedTask], FixedTask]) -> str:
        """Change the document.

        Args:
            change: Returns the changed document.

        Returns:
            Why the edit is not possible; empty when it was made, or changes nothing. A scene that violates a constraint
            is possible: the checks name it.
        """
        with self.lock:
            try:
                made = self.history.change(change(self.history.now))
            except RoboximError as error:
                return str(error)
        if made:
            self._changed()
        return ""

    def undo(self) -> None:
        """Go back one edit."""
        with self.lock:
            made = self.history.undo()
        if made:
            self._changed()

    def redo(self) -> None:
        """Make an undone edit again."""
        with self.lock:
            made = self.history.redo()
        if made:
            self._changed()

    def refresh(self) -> Future[Checks]:
        """Check the document, and draw its pictures."""
        return self._changed()

    def check(self, *, slow: bool = True) -> Checks:
        """Check the document now; call it on the bench."""
        document = self.history.now
        try:
            config = checked(document, self._library)
        except RoboximError as error:
            return Checks(of=document, error=str(error), whole=True)
        return Checks(of=document, findings=self._findings(config, slow), whole=slow)

    def _findings(self, config: FixedTaskConfig, slow: bool) -> tuple[Finding, ...]:
        return tuple(self._lab.graph.tasks.generator.findings(config, SEED, slow=slow))

    def save(self, folder: Path, name: str) -> Path:
        """Write the document as a task's YAML.

        Args:
            folder: Folder that was opened.
            name: File name; ``.yaml`` is added.

        Returns:
            The file, which ``generate --task`` and ``evaluate --task`` take.

        Raises:
            ConfigError: When the name is no plain file name or that of another file, or the document is no valid task.
            OSError: When it cannot be written.
        """
        file = file_to_save(folder, name)
        document = self.history.now
        checked(document, self._library)
        self.own_files.write(file, f"# Made with roboxim studio; scene {scene_hash(document)}.\n{as_yaml(document)}")
        return file

    def _changed(self) -> Future[Checks]:
        for listener in self.on_change:
            listener()
        self._bench.do(self._quick, newest_of="quick checks")
        self._bench.do(self._draw, newest_of="pictures")
        return self._bench.do(self._full_check, newest_of="checks")

    def _quick(self) -> None:
        self._set(self.check(slow=False))

    def _full_check(self) -> Checks:
        checks = self.check()
        self._set(checks)
        if checks.valid and checks.of == self.history.now:
            path = self._path(checked(checks.of, self._library))
            for listener in self.on_plan:
                listener(path)
        return checks

    def _path(self, config: FixedTaskConfig) -> Points:
        """Return the way of the tool in the expert's plan, in the world, shape (ticks + 1, 3) [m]."""
        solution = self._lab.graph.tasks.generator.solution(config, SEED)
        arm, base = self.arm(), config.fixed.scene.robot.pose
        rows = () if solution is None else solution.path
        return np.array([base.apply(arm.fk(joints).position) for joints in rows], dtype=float).reshape(-1, 3)

    def _set(self, checks: Checks) -> None:
        if checks.of == self.history.now:
            self.checks = checks
            for listener in self.on_checks:
                listener()

    def _draw(self) -> None:
        document = self.history.now
        try:
            pictures = self._lab.pictures(document.fixed.scene, self.state(document.fixed.scene))
        except RoboximError:
            return  # the checks name what is wrong with the scene
        if document == self.history.now:
            for listener in self.on_pictures:
                listener(pictures)


def start_of(scene: SceneSpec, arm: ArmKinematics) -> StateRecord:
    """Return the start of a scene, as if nothing moved while it settles.

    Args:
        scene: The scene; a robot without a start is at its home.
        arm: Kinematics of its robot.
    """
    if not scene.robot.joint_positions:
        home = tuple(float(value) for value in arm.model.home)
        scene = replace(scene, robot=replace(scene.robot, joint_positions=home))
    return state_at_rest(scene, arm)


def file_to_save(folder: Path, name: str) -> Path:
    """Return the YAML file of a name in a folder that was opened.

    Raises:
        ConfigError: When the name is no plain file name.
    """
    stem = name.removesuffix(".yaml")
    if not is_file_name(stem) or "/" in stem:
        raise ConfigError(f"'{name}' is no file name; expected letters, digits, '-' and '_', e.g. my_scene")
    return folder / f"{stem}.yaml"
