"""The panel of a dataset of RLDS, LeRobot or HDF5: an episode's pictures, actions and observations, step by step.

A dataset has no states. Its arm is shown in 3D where joint positions are stated; an episode of a bag names it.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from roboxim_core.errors import RoboximError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.specs import RobotSpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_datasets.choosing import facts_of
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode, Step
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.plans import Place
from roboxim_datasets.where import Fact
from roboxim_studio.background import program_ends, run_beside
from roboxim_studio.bench import Bench
from roboxim_studio.episode.arm_track import ArmTrack, arm_track, arms_that_fit, named_arm
from roboxim_studio.episode.film import Pictures
from roboxim_studio.episode.statistics import Distribution, distributions
from roboxim_studio.look.scene_view import SceneView
from roboxim_studio.panels import markup
from roboxim_studio.panels.editor_forms import by_person
from roboxim_studio.panels.pictures import show_pictures
from roboxim_studio.panels.plots import COLOURS, Plot, add_distributions
from roboxim_studio.panels.selection import CONDITIONS_HINT, MARKS, Listed, OpenEpisode, Selection, meeting
from roboxim_studio.serving.site import Site
from roboxim_tasks.files import named

MAX_MEASURED = 500
"""Episodes whose actions are measured; those of larger datasets are the first ones."""
UNKNOWN = "unknown"
ALL = "choose one"
MAX_LISTED = 500
"""Episodes that meet conditions and are listed."""
LARGEST_PX = 256
"""Longer side of the pictures [px]; larger ones are scaled down."""


class DatasetPanel:
    """Shows one episode of a dataset."""

    def __init__(self, site: Site, view: SceneView, library: ModelLibrary, bench: Bench, folder: Path) -> None:
        """Build the panel in the current container; it stays hidden until a dataset is opened.

        Args:
            site: The page.
            view: The three-dimensional view.
            library: The arms that can be shown.
            bench: Where episodes are read to filter them.
            folder: Folder to save selections into.
        """
        self._bench, self._saves = bench, folder
        self.selection: Selection | None = None
        """What is marked and edited."""
        self._place = ("", 0)
        self._request = 0
        self._known: dict[str, dict[str, Fact]] = {}
        self._found: list[str] = []
        self._numbers: dict[str, int] = {}
        self._site, self._gui, self._view, self._library = site, site.viser.gui, view, library
        self.track: ArmTrack | None = None
        """Where the arm is at every step; none: not known."""
        self.number = 0
        """The step that is shown."""
        self._rows: list[Step] = []
        self._arm = UNKNOWN
        self._active = False
        self.folder = self._gui.add_folder("Dataset", visible=False)
        self.dataset: Dataset | None = None
        """The dataset."""
        self.episode: Episode | None = None
        """Its episode that is shown."""
        self._pictures = Pictures()
        self._fresh: list[Any] = []
        self._own: list[Any] = []
        self._images: dict[str, Any] = {}
        self._lock = threading.RLock()

    def open(self, path: Path) -> None:
        """Open a dataset at its first episode.

        Raises:
            RoboximError: When it cannot be read.
        """
        self.dataset = open_dataset(path)
        gui = self._gui
        splits = ", ".join(f"{name} {count}" for name, count in self.dataset.splits.items())
        with self.folder:
            gui.add_html(
                markup.facts(
                    [("folder", path.name), ("episodes", f"{len(self.dataset)} ({splits})")], "dataset-facts"
                )
            )  # fmt: skip
            conditions = gui.add_text("Conditions", initial_value="", hint=CONDITIONS_HINT)
            self._meeting: Any = gui.add_dropdown("Meeting them", (ALL,), initial_value=ALL, visible=False)
            self._number: Any = gui.add_number(
                "Episode", initial_value=0, min=0, max=max(0, len(self.dataset) - 1), step=1
            )
            self._marked = gui.add_html("")
            self.selection = Selection(
                gui, self._saves, path, opened=self._open_episode, chosen=lambda: self._name,
                changed=self._list, command="roboxim dataset convert lerobot {source} --where {file} --out ...",
            )  # fmt: skip
            with self.selection.folder:
                measure = gui.add_button("Measure all episodes")
                self._measured = gui.add_folder("Distributions", visible=False)
        places = [self.dataset.place(index) for index in range(len(self.dataset))]
        names = [f"{split}/{index}" for split, index in places]
        self.selection.listed = {name: Listed(source=path, episode=name) for name in names}
        self._numbers = {name: number for number, name in enumerate(names)}
        conditions.on_update(by_person(lambda text: self._bench.do(lambda: self.filter(str(text)), newest_of="filter")))
        self._meeting.on_update(lambda event: self._show_named(str(event.target.value)) if event.client else None)
        self._number.on_update(lambda event: self.show(int(event.target.value)) if event.client else None)
        measure.on_click(lambda _: threading.Thread(target=self.measure, name="measure", daemon=True).start())
        self.folder.visible = self._active = True
        self.show(0)

    def show(self, index: int) -> None:
        """Show an episode by its number; one that cannot be read is named, and the one before stays.

        Of several requests at once the newest one counts.
        """
        assert self.dataset is not None
        with self._lock:
            self._request += 1
            request = self._request
        try:
            place = self.dataset.place(index)
            episode = self.dataset.episode(index)
            rows = [step for step in episode.steps(cameras=())]
        except RoboximError as error:
            with self._lock:
                if request == self._request:
                    self._number.value = self._numbers.get(self._name, 0)
                    self._site.send(alert=str(error))
            return
        with self._lock:
            if request != self._request:
                return
            self._site.send(alert="")
            self._place = place
            self.episode, self._pictures, self._rows, self.number = episode, Pictures(), rows, 0
            self._arm = named_arm(episode, self._library) or UNKNOWN
            for handle in self._own:
                handle.remove()
            self._own, self._images = [], {}
            with self.folder:
                self._build(episode, rows)
            self.choose_arm(self._arm)
            pictures = self._pictures
        run_beside(partial(self._fill, episode, pictures), "pictures")

    def _build(self, episode: Episode, rows: list[Any]) -> None:
        gui = self._gui
        outcome = {True: "success", False: "failure", None: "not stated"}[episode.success]
        facts = gui.add_html(
            markup.facts(
                [
                    ("episode", episode.episode_id or "no id"), ("instruction", episode.instruction),
                    ("outcome", outcome), ("steps", len(episode)), ("robot", episode.robot or "not stated"),
                    ("bag", str(episode.metadata.get("file_path", "not stated"))),
                ],
                "dataset-episode",
            )
        )  # fmt: skip
        fits = () if self._arm != UNKNOWN else arms_that_fit(episode, rows, self._library)
        arms: Any = gui.add_dropdown(
            "Arm", tuple(dict.fromkeys((self._arm, UNKNOWN, *fits))), initial_value=self._arm,
            hint="The arm that is shown in 3D; those offered have as many joints, and reach these positions.",
        )  # fmt: skip
        arms.on_update(lambda event: self.choose_arm(str(event.target.value)) if event.client else None)
        self._arm_text = gui.add_html("")
        self._slider: Any = gui.add_slider("Step", min=0, max=max(1, len(episode) - 1), step=1, initial_value=0)
        self._slider.on_update(lambda event: self.step(int(event.target.value)) if event.client else None)
        self._folder = gui.add_folder("Pictures")
        curves = gui.add_folder("Plots")
        with curves:
            for plot in _plots(episode, rows):
                gui.add_uplot(plot.data(), plot.series(), title=plot.title, height=170)
        self._own = [facts, arms, self._arm_text, self._slider, self._folder, curves]

    def choose_arm(self, name: str) -> None:
        """Show the positions of the joints with an arm, or say why that is not possible."""
        with self._lock:
            if self.episode is None or name not in (UNKNOWN, *self._library.robot_ids):
                return
            why = "the dataset names no known arm; choose one above"
            found: ArmTrack | str = why
            if name != UNKNOWN:
                found = arm_track(self.episode, self._rows, self._library.robot(name))
            self.track = found if isinstance(found, ArmTrack) else None
            if self.track is None:
                text = f"no 3D: {found}"
            else:
                fingers = "" if self.track.opening is not None else "; the gripper's opening is not known, it is open"
                text = f"in 3D: '{self.track.source}' as the joints of {name}{fingers}"
            self._arm_text.content = markup.paragraph(text, "dataset-arm")
            self.show_again()

    def filter(self, text: str) -> None:
        """Offer the episodes that meet conditions, as ``--where`` takes them; empty: all. Reads each episode once."""
        assert self.dataset is not None
        assert self.selection is not None
        self._meeting.visible = bool(text.strip())
        if not text.strip():
            self.selection.show_message("")
            return
        try:
            for number, name in enumerate(self._numbers):
                if self._bench.stopping.is_set():
                    return
                if number % 20 == 0:
                    self.selection.show_message(f"{number} of {len(self._numbers)} episodes read")
                if name not in self._known:
                    split, index = self.dataset.place(number)
                    self._known[name] = facts_of(Place(dataset=self.dataset, split=split, index=index))
            found = meeting(text, self._known)
        except RoboximError as error:
            self.selection.show_message(str(error), alert=True)
            return
        self._found = [name for name in self._numbers if name in found]
        self._list()
        self.selection.show_message(f"{len(found)} of {len(self._numbers)} episodes meet the conditions")

    def _list(self) -> None:
        """Show the marks, and the names of the episodes that meet the conditions."""
        assert self.selection is not None
        self._marked.content = markup.facts(rows, "dataset-marks") if (rows := self.selection.rows()) else ""
        names = [
            f"{self.selection.mark_of(name)}{name} | {self._known[name]['instruction'][0]}" for name in self._found
        ]
        self._meeting.options = (ALL, *names[:MAX_LISTED])

    def _show_named(self, shown: str) -> None:
        name = shown.removeprefix(MARKS["flag"]).removeprefix(MARKS["out"]).partition(" | ")[0]
        if name in self._numbers:
            self._number.value = self._numbers[name]
            self.show(self._numbers[name])

    def _open_episode(self) -> OpenEpisode | None:
        if self.episode is None:
            return None
        number = self.number
        return OpenEpisode(name=self._name, starts=number, ends=number, last=len(self.episode) - 1)

    @property
    def _name(self) -> str:
        """Name of the episode that is shown."""
        return "/".join(map(str, self._place))

    def close(self) -> None:
        """Read no further pictures."""
        self._pictures = Pictures()

    def hide(self) -> None:
        """Leave the view to another panel."""
        self._active = False

    def show_again(self) -> None:
        """Take the view."""
        with self._lock:
            self._active = True
            if self.track is not None:
                base = named("scenes", "empty_table", SceneSpec)
                robot = RobotSpec(model=self.track.model.id, pose=base.robot.pose)
                self._view.load(replace(base, robot=robot, cameras=(), entities=()), without=("table", "wall"))
                self._show_arm()
            else:
                self._view.clear()

    def _show_arm(self) -> None:
        if self._active and self.track is not None and self.number < len(self.track.joints):
            seq = self.number
            self._view.show(StateRecord(episode_id="", seq=seq, stamp_ns=0, robot=self.track.state(seq)))

    def measure(self) -> tuple[Distribution, ...]:
        """Read the actions of all episodes, at most `MAX_MEASURED`, and show how they are distributed."""
        assert self.dataset is not None
        count = min(len(self.dataset), MAX_MEASURED)
        actions = []
        for index in range(count):
            try:
                actions += [step.action for step in self.dataset.episode(index).steps(cameras=())]
            except RoboximError as error:
                self._site.send(alert=str(error))
            if index % 10 == 0:
                self._site.send(hint=f"{index} of {count} episodes read")
        self._site.send(hint="")
        widths = {len(action) for action in actions}
        if len(widths) != 1:
            self._site.send(alert=f"the episodes have actions of several lengths: {sorted(widths)}" if widths else "")
            return ()
        semantics = self.episode.semantics if self.episode else None
        width = widths.pop()
        names = semantics.component_names(self.episode.joint_names) if semantics and self.episode else ()
        if len(names) != width:
            names = tuple(map(str, range(width)))
        found = distributions(np.array(actions, dtype=float), names)
        with self._lock, self._measured:
            for handle in tuple(self._measured._children.values()):
                handle.remove()
            add_distributions(self._gui, found, f"{len(actions)} actions of {count} episodes")
        self._measured.visible = True
        return found

    def step(self, number: int) -> None:
        """Show the arm at a step, and those of its pictures that have come; the others follow."""
        with self._lock:
            self.number = self._slider.value = number
            self._show_arm()
            self._show_pictures()

    def _show_pictures(self) -> None:
        """Show the pictures of the step, and none of another step."""
        with self._lock:
            images = self._pictures.at(self.number)
            for name, handle in self._images.items():
                handle.visible = name in images
            show_pictures(self._gui, self._folder, self._images, images)

    def _fill(self, episode: Episode, pictures: Pictures) -> None:
        try:
            for step in episode.steps(cameras=tuple(episode.cameras)):
                if program_ends() or self._pictures is not pictures:  # another episode is shown
                    break
                pictures.add(step.index, {name: _scaled(image) for name, image in step.images.items()})
                if self._pictures is pictures and step.index == self.number:
                    self._show_pictures()
        except RoboximError as error:
            self._site.send(alert=str(error))
        finally:
            pictures.complete.set()


def _scaled(image: Any) -> Any:
    factor = LARGEST_PX / max(image.shape[:2])
    if factor >= 1.0:
        return image
    return cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def _plots(episode: Episode, rows: list[Any]) -> list[Plot]:
    """Return the curves of the action and of every observed vector with at most as many parts as there are colours."""
    found = []
    actions = np.array([row.action for row in rows], dtype=float)
    vectors = {"action": (tuple(str(n) for n in range(actions.shape[1])), actions)} if actions.ndim == 2 else {}
    for name, parts in episode.vectors.items():
        vectors[name] = (tuple(parts), np.array([row.proprio[name] for row in rows], dtype=float))
    for name, (parts, values) in vectors.items():
        for first in range(0, values.shape[1], len(COLOURS)):
            some = slice(first, first + len(COLOURS))
            found.append(Plot(title=name, names=parts[some], values=tuple(values[:, some].T)))
    return found
