"""The panel in which a person drives: keys, gamepad or gizmo; ticks; keeping or throwing away."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.episode import Draw, EpisodeStep
from roboxim_core.errors import ConfigError, PolicyError, RoboximError
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.state import StateRecord
from roboxim_recorder.acted import ActedBy
from roboxim_studio.acting.drive import Drive, continued, next_index
from roboxim_studio.acting.lab import Lab
from roboxim_studio.acting.partner import Partner
from roboxim_studio.acting.space_mouse import SpaceMouse
from roboxim_studio.acting.steering import (
    BEGIN,
    GRIPPER,
    HAND,
    HELP,
    KEEP,
    THROW,
    Speeds,
    Steering,
    action_of,
    moves,
    offset_words,
)
from roboxim_studio.acting.what_if import EXPERT
from roboxim_studio.bench import Bench
from roboxim_studio.editing.document import as_yaml
from roboxim_studio.episode.film import Film, ending
from roboxim_studio.look.scene_view import SceneView, wxyz
from roboxim_studio.panels import markup
from roboxim_studio.panels.compose import ComposePanel
from roboxim_studio.panels.editor import EditorPanel
from roboxim_studio.panels.pictures import show_pictures
from roboxim_studio.serving.site import Site

FOLDER = "teleoperation"
"""Folder below the studio's that bags are written to, unless the command line names another."""
SILENT_S = 0.5
"""Time without a message from a page after which its keys count as released [s]."""
DRAWN, EDITED, OPENED = "the task's next scene", "the edited scene", "the open episode, from its tick"
NOBODY = "nobody"
SPACE_MOUSE = "Connect a SpaceMouse"
"""Label of a button that the page's script obeys (`studio.js`): a browser shows its devices only at a click."""
HAND_HELP = "T: take over, or hand back"


class DrivePanel:
    """Drives one episode at a time. Keys of several pages add up."""

    def __init__(
        self, site: Site, view: SceneView, bench: Bench, lab: Lab, editor: EditorPanel, compose: ComposePanel,
        folder: Path, watch: Callable[[Film], None], opened: Callable[[], tuple[Film | None, int]],
    ) -> None:  # fmt: skip
        """Build the panel in the current container.

        Args:
            site: The page.
            view: The three-dimensional view.
            bench: Where the simulator runs.
            lab: What it runs with.
            editor: Gives the edited scene.
            compose: Gives the task, the seed and the index.
            folder: Folder of the bags.
            watch: Called with an episode that was kept.
            opened: Returns the episode that is open in the studio, and the tick that it shows.
        """
        self._site, self._gui, self._view = site, site.viser.gui, view
        self._bench, self._lab, self._editor, self._compose = bench, lab, editor, compose
        self.bags = folder
        """Folder of the bags."""
        self._watch, self._opened = watch, opened
        self.drive: Drive | None = None
        """The episode; none: none was begun."""
        self.kept = 0
        """Number of episodes that were kept since the studio began."""
        self.solved = 0
        """Number of those that are a success."""
        self._received: dict[int, tuple[float, Mapping[str, Any]]] = {}
        self._target: Pose | None = None
        self._base = Pose()
        self._opening = 1.0
        self._pressed: dict[int, frozenset[str]] = {}
        self._pending: Steering | None = None
        self._served = self._moving = False
        self._plumb: Any = None
        self._verdict = ""
        self._ending = ""
        self._lock = threading.RLock()
        self._gizmo: Any = None
        self._images: dict[str, Any] = {}
        self._judging: list[StateRecord] = []
        self._closed = threading.Event()
        self._running = threading.Event()
        gui = self._gui
        self.folder = gui.add_folder("Drive", visible=False)
        with self.folder:
            self._source: Any = gui.add_dropdown("Scene", (DRAWN, EDITED, OPENED), initial_value=DRAWN)
            self._partner: Any = gui.add_dropdown(
                "Acts with you", (NOBODY, EXPERT, *lab.policies), initial_value=NOBODY,
                hint="Begins the episode; take over and hand back with T.",
            )  # fmt: skip
            self._waits = gui.add_checkbox("Time stops while no input is held", initial_value=True)
            self._speed = gui.add_slider("Speed [m/s]", 0.02, 0.4, 0.01, 0.2)
            start = gui.add_button("Begin an episode")
            buttons = gui.add_button_group("Then", ("End and keep", "Throw away", "Watch it"))
            grip = gui.add_button("Open or close the gripper")
            hand = gui.add_button("Take over, or hand back")
            gui.add_button(SPACE_MOUSE, hint="By WebHID, which Chromium has; the browser asks which device.")
            self._message = gui.add_html(markup.paragraph(HELP, "drive"))
            self._lamps = gui.add_html("")
            self._pictures = gui.add_folder("Cameras")
        start.on_click(lambda _: self.begin() and None)
        grip.on_click(lambda _: self.key(GRIPPER))
        hand.on_click(lambda _: self.key(HAND))
        buttons.on_click(lambda event: self._button(str(event.target.value)))
        threading.Thread(target=self._tick, name="driver", daemon=True).start()

    # ---------------------------------------------------------------- episodes

    @property
    def driving(self) -> bool:
        """Whether an episode is going on."""
        return self.drive is not None and self.drive.runs

    def prefer_edits(self) -> None:
        """Offer the edited scene first, if there are edits, else the task's."""
        if self._source.value != OPENED:
            desk = self._editor.desk
            self._source.value = EDITED if desk is not None and desk.history.edited else DRAWN

    def begin(self) -> Any:
        """Begin an episode; returns the future drive. One that is running is set apart first."""
        return self._bench.do(self._begin)

    def _begin(self) -> Drive | None:
        apart = self.leave()
        seed = self._compose.seed
        index = next_index(self.bags, seed)
        seed = type(seed)(run_seed=seed.run_seed, purpose=seed.purpose, index=index)
        self._show_message(f"drawing index {index} ...")
        try:
            chosen = str(self._partner.value)
            partner = None if chosen == NOBODY else Partner(chosen, self._lab.actor(chosen))
            draw, after = self._scene(seed)
            self._editor.hide()  # a scene that was drawn beside this panel
            self._editor.folder.visible = False
            self._view.load(draw.scene)
            self._view.hide_cameras(True)  # the wrist's picture would hide what the gripper is above
            self._judging = []
            drive = Drive(self._lab.graph, draw, seed, self.bags, on_tick=self._shown, partner=partner, after=after)
        except RoboximError as error:
            self._show_message(str(error), alert=True)
            return None
        with self._lock:
            self.drive, self._ending, self._target = drive, "", None
            self._base, self._opening = draw.scene.robot.pose, drive.state.robot.gripper_command
            self._place_gizmo(drive.state.robot.pose_tcp_commanded)
        self._show_message("\n".join(filter(None, (apart, draw.task.instruction, HELP, HAND_HELP if partner else ""))))
        self._site.send(driving=True, hint=draw.task.instruction, alert="")
        self._show_actor(drive)
        self._running.set()
        return drive

    def _scene(self, seed: SeedPath) -> tuple[Draw, list[tuple[StateRecord, ActedBy]]]:
        """Return the chosen task and scene, and the states that are executed before the person acts."""
        desk, (film, tick) = self._editor.desk, self._opened()
        if self._source.value == OPENED:
            if film is None:
                raise ConfigError("no episode is open; open one in 'Episode', or choose another scene")
            return continued(film, tick)
        edited = self._source.value == EDITED and desk is not None
        text = as_yaml(desk.document) if edited and desk is not None else self._compose.text
        return self._lab.draw(text, seed), []

    def _hand(self, drive: Drive, *, to_partner: bool, why: str = "") -> None:
        """Give control to the partner or to the person; on the bench."""
        if drive is not self.drive or drive.result is not None:
            return
        with self._lock:
            self._target, self._opening = None, drive.state.robot.gripper_command
        drive.hand(to_partner=to_partner)
        self._show_actor(drive, why)

    def _show_actor(self, drive: Drive, why: str = "") -> None:
        self._show_line(drive.state)
        if drive.partner is None:
            return
        actor = f"{drive.partner.name} acts; T: take over" if drive.partner_acts else "you act; T: hand back"
        self._site.send(hint=f"{drive.instruction}\n{actor}", alert=why)

    def pause(self) -> None:
        """Execute no further tick; another panel takes the view, and `leave` follows on the bench."""
        self._running.clear()

    def leave(self) -> str:
        """Set a running episode apart; on the bench. Returns where it is, in words; empty: none was running."""
        self._running.clear()
        drive, self.drive = self.drive, None
        text = ""
        if drive is not None and (path := drive.close()):
            text = f"the running episode was not ended: it is set apart as {self.bags.name}/{path}"
            self._show_message(text)
        self._stop_driving()
        return text

    def _stop_driving(self) -> None:
        with self._lock:
            self._view.hide_cameras(False)
            if self._gizmo is not None:
                self._gizmo.remove()
                self._gizmo = None
            self._received.clear()
            self._pending = None
            if self._plumb is not None:
                self._plumb.remove()
                self._plumb = None
        self._site.send(driving=False, hint="")

    def close(self) -> None:
        """End the driver; call `leave` on the bench afterwards."""
        self._closed.set()
        self._running.set()

    def _button(self, what: str) -> None:
        if what == "End and keep":
            self.key(KEEP)
        elif what == "Throw away":
            self.key(THROW)
        elif self.drive is not None and self.drive.film is not None:
            self._watch(self.drive.film)

    # ---------------------------------------------------------------- input

    def receive(self, page: int, message: Mapping[str, Any]) -> None:
        """Store the keys that a page holds; an empty message: the page was closed. Called in the server's thread."""
        with self._lock:
            if not message:
                self._received.pop(page, None)
                self._pressed.pop(page, None)
                return
            if "held" in message:
                self._received[page] = (time.monotonic(), message)
                steering = Steering.of_message(message)
                before, now = self._pressed.get(page, frozenset()), steering.once()
                self._pressed[page] = now
                moving = any(steering.directions())
                if moving:
                    self._pending, self._served = steering, self._served and self._moving
                elif self._served:  # a tick was made of what is released; one that came between two ticks is still owed
                    self._pending = None
                self._moving = moving
        if "held" in message:
            for code in now - before:
                self.key(code)

    def key(self, code: str) -> None:
        """Handle a key that acts once."""
        if code == BEGIN and not self._running.is_set():
            self.begin()
        if self.drive is None:
            return
        with self._lock:
            if code == GRIPPER:
                self._opening = 0.0 if self._opening > 0.5 else 1.0
            elif code == HAND:
                drive = self.drive
                self._bench.do(lambda: self._hand(drive, to_partner=not drive.partner_acts))
            elif code in (KEEP, THROW):
                if self._running.is_set():
                    self._ending = code
                elif code == THROW:
                    self._bench.do(self._throw)

    def steering(self) -> Steering:
        """Return the combined input of all pages."""
        now = time.monotonic()
        with self._lock:
            fresh = [message for stamp, message in self._received.values() if now - stamp < SILENT_S]
            all_held = [Steering.of_message(message) for message in fresh]
            pad = next((one for one in all_held if one.axes), Steering())
            mouse = next((one.space_mouse for one in all_held if one.space_mouse.directions), SpaceMouse())
            held = frozenset().union(*(one.held for one in all_held))
            return Steering(
                held=held, axes=pad.axes, buttons=pad.buttons, space_mouse=mouse, target=self._target
            )  # fmt: skip

    def _taken(self) -> Steering:
        """Return what moves the tool in the next tick.

        Each message of a page moves the tool by one tick. So a tap always moves it once, and a slow page shows every
        tick before the next one. In real time, a held key counts until it is released.
        """
        with self._lock:
            pending, self._pending = self._pending, None
            self._served = self._served or pending is not None
        now = self.steering()
        if pending is not None:
            return replace(pending, held=pending.held | now.held if any(now.directions()) else pending.held)
        return replace(now, held=frozenset(), axes=(), space_mouse=SpaceMouse()) if self._waits.value else now

    def _place_gizmo(self, pose_tcp: Pose) -> None:
        if self._gizmo is not None:
            self._gizmo.remove()
        self._gizmo = self._site.viser.scene.add_transform_controls(
            "/drive/target", scale=0.18, position=pose_tcp.position, wxyz=wxyz(pose_tcp), depth_test=False
        )
        self._gizmo.on_update(self._dragged)

    async def _dragged(self, event: Any) -> None:
        w, x, y, z = (float(value) for value in event.target.wxyz)
        px, py, pz = (float(value) for value in event.target.position)
        norm = (w * w + x * x + y * y + z * z) ** 0.5 or 1.0
        pose = Pose(position=(px, py, pz), quat_xyzw=(x / norm, y / norm, z / norm, w / norm))
        with self._lock:
            self._target = self._base.inverse() @ pose

    # ---------------------------------------------------------------- ticks

    def _tick(self) -> None:
        """Advance at the control rate; in lockstep only while something moves."""
        due = time.monotonic()
        while not self._closed.is_set():
            if not self._running.wait(0.5) or self._closed.is_set():
                continue
            drive = self.drive
            if drive is None:
                continue
            due = max(due + 1.0 / drive.rate_hz, time.monotonic() - 1.0 / drive.rate_hz)
            self._closed.wait(max(0.0, due - time.monotonic()))
            try:
                self._bench.do(lambda drive=drive: self._advance(drive)).result()  # type: ignore[misc]
            except Exception as error:  # this thread must outlive every fault: without it nothing could be driven
                self._running.clear()
                named = isinstance(error, RoboximError)
                self._show_message(str(error) if named else f"{type(error).__name__}: {error}", alert=True)

    def _advance(self, drive: Drive) -> None:
        """Execute what is held, on the bench."""
        if drive is not self.drive or not self._running.is_set():
            return
        if self._ending == THROW:
            self._throw()
            return
        if drive.partner_acts:
            self._partner_advance(drive)
            return
        state, steering = drive.state, self._taken()
        commanded = self._base.inverse() @ state.robot.pose_tcp_commanded
        speeds = Speeds(translation_m_s=float(self._speed.value))
        action = action_of(steering, commanded, self._opening, drive.rate_hz, speeds)
        last = self._ending == KEEP
        fingers_move = abs(state.robot.gripper_opening - self._last_opening(drive)) > 0.01
        if self._waits.value and not last and not fingers_move and not moves(action, state.robot.gripper_command):
            return
        if any(steering.directions()) and self._gizmo is not None:  # keys take over from the gizmo
            self._target = None
        if not drive.step(action, last=last):
            self._ended(drive)

    def _partner_advance(self, drive: Drive) -> None:
        """Let the partner act; if it cannot, the person has control."""
        try:
            if not drive.partner_step(last=self._ending == KEEP):
                self._ended(drive)
        except PolicyError as error:
            self._hand(drive, to_partner=False, why=f"{error}\nYou have control.")

    def _last_opening(self, drive: Drive) -> float:
        before = self._judging[-2] if len(self._judging) > 1 else drive.state
        return before.robot.gripper_opening

    def _ended(self, drive: Drive) -> None:
        self._running.clear()
        self._stop_driving()
        film = drive.film
        assert film is not None
        self._show_line(film.states[-1])
        self._count(drive, 1)
        kept = f"kept as {drive.bag.name}" if drive.bag is not None else ""
        self._show_message(
            f"{ending(film)} after {film.result.steps} actions; {kept}\nBackspace or 'Throw away' removes it, "
            f"N begins the next\nkept so far: {self.kept}, of them solved: {self.solved}"
        )
        self._site.send(hint=f"{ending(film)}; Backspace throws it away, N begins the next")

    def _count(self, drive: Drive, number: int) -> None:
        """Count an episode that was kept, or with -1 one that is thrown away after all."""
        if drive.bag is not None and drive.film is not None:
            self.kept += number
            self.solved += number * (drive.film.result.outcome == "success")

    def _throw(self) -> None:
        drive, self._ending = self.drive, ""
        self._running.clear()
        if drive is not None:
            self._count(drive, -1)
            drive.throw_away()
            self.drive = None
        self._stop_driving()
        self._show_message("thrown away")

    def _shown(self, state: StateRecord, step: EpisodeStep) -> None:
        images = {name: seen.rgb for name, seen in self._lab.graph.sim.images.items()}
        self._view.show(state, images)
        self._judging.append(state)
        if self._gizmo is not None and self._target is None:
            pose = state.robot.pose_tcp_commanded
            self._gizmo.position, self._gizmo.wxyz = pose.position, wxyz(pose)
        self._verdict = "solved" if step.verdict.success else step.verdict.reason
        self._show_line(state)
        show_pictures(self._gui, self._pictures, self._images, images)

    def _show_line(self, state: StateRecord) -> None:
        """Show the tick, who acts, and where the tool is; a plumb line from it to the table."""
        drive, scene = self.drive, self._view.scene
        if scene is None:
            return
        partner = drive.partner if drive is not None and drive.partner_acts else None
        actor = f"{partner.name} acts" if partner is not None else "you act; time stops until you move"
        if partner is None and not self._waits.value:
            actor = "you act"
        over = drive is not None and drive.result is not None
        lines = [f"tick {state.seq}   {self._verdict}   {'ended' if over else actor}"]
        lines.append(f"gripper: {100 * state.robot.gripper_opening:.0f} % open")
        tool = state.robot.pose_tcp_measured.position
        if drive is not None and drive.aim in {entity.name for entity in state.entities}:
            aim = state.entity(drive.aim).pose.position
            lines.append(offset_words(scene.robot.pose, tool, aim, drive.aim))
        self._lamps.content = markup.paragraph("\n".join(lines), "drive-verdict")
        if self._plumb is not None:
            self._plumb.remove()
        foot = (tool[0], tool[1], scene.table.center[2])
        self._plumb = self._site.viser.scene.add_line_segments(
            "/drive/plumb", np.array([[tool, foot]], np.float32), colors=(230, 60, 200), thickness=2.0,
            thickness_units="screen",
        )  # fmt: skip

    def _show_message(self, text: str, *, alert: bool = False) -> None:
        self._message.content = markup.paragraph(text, "drive", alert=alert)
