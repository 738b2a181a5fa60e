"""The dry run of a remote policy: observations of a real episode, the answers to them, and suspicious findings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from roboxim_core.actions import ActionSemantics
from roboxim_core.actions.gripper import GripperSwitch
from roboxim_core.conventions import Convention, Layout, decode_actions, from_actions
from roboxim_core.conventions.images import Picture
from roboxim_core.errors import RoboximError
from roboxim_core.policies import EpisodeStart
from roboxim_core.rotation.representations import Floats
from roboxim_core.vision.cameras import load_camera
from roboxim_policies.dry_run import ORIENTATIONS, Answers, RoundTrip, proven, round_trip, suspicions
from roboxim_policies.remote import RemotePolicy
from roboxim_runs.episodes.expert_episode import ExpertEpisode, expert_episode
from roboxim_runs.policies.sketch import Sketch

DRY_RUN_TICKS = 6
"""Number of ticks of the expert's episode at which the policy is called."""
LABEL_PX = 20
COLUMN_PX = 310
"""Least width of a picture's column, for its words."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PolicyCheck:
    """Result of a dry run."""

    lines: tuple[str, ...]
    """What the server declared, what was sent, and what the answers mean."""
    suspicions: tuple[str, ...]
    """What looks wrong."""
    round_trip: RoundTrip
    """What became of the expert's actions in the convention."""
    sheet: Image.Image
    """The pictures as they were sent."""

    @property
    def passed(self) -> bool:
        """Whether nothing looks wrong."""
        return not self.suspicions and self.round_trip.is_exact


def check_policy(
    policy: RemotePolicy, task_config: str = "", *, seed: int = 0, renderer: str = "raster",
    on_step: Callable[[str], None] = lambda text: None,
) -> PolicyCheck:  # fmt: skip
    """Ask a remote policy at some ticks of an episode of the expert.

    Args:
        policy: The policy.
        task_config: Task as YAML text; empty: the default task.
        seed: Seed of the episode.
        renderer: Renderer of its pictures.
        on_step: Called with what is being done.

    Raises:
        PolicyError: When the server cannot be reached, does not fit the convention, or its answers cannot be used.
        EvaluationError: When the expert does not solve the task.
    """
    convention = policy.convention
    on_step(f"connecting to {policy.wire.server}")
    metadata = policy.connect()
    on_step("running an episode of the expert")
    episode = expert_episode(
        task_config, cameras=convention.cameras, rate_hz=convention.rate_hz, seed=seed, renderer=renderer
    )
    on_step("asking the policy")
    ticks = sorted({int(tick) for tick in np.linspace(0, len(episode.actions) - 1, DRY_RUN_TICKS)})
    policy.reset(EpisodeStart(episode_id=episode.result.episode_id, instruction=episode.instruction, seed=seed))
    requests = [policy.request(episode.window(tick, convention.window)) for tick in ticks]
    raw = [policy.raw(episode.window(tick, convention.window)) for tick in ticks]
    for rows in raw:
        policy.decoded(rows)  # which refuses what cannot be used
    used = [rows[: convention.chunking.horizon] for rows in raw]
    pictures = {image.key: _upright(convention, image.key, requests[0][image.key]) for image in convention.images}
    seen = episode.observations[0].images
    upright = {
        image.key: replace(image, mirror=False, upside_down=False, layout=Layout.HWC).prepare(seen[image.camera])
        for image in convention.images
    }
    answers = Answers(
        raw=used, pictures=pictures, upright=upright, expert=episode.actions[ticks], expert_speed=episode.speed,
        joints=episode.joints[ticks], expert_joint_speed=episode.joint_speed,
    )  # fmt: skip
    lines = [
        f"server      {policy.wire.server}",
        f"metadata    {str(metadata)[:300] if metadata else 'none'}",
        f"convention  {convention.name}: {convention.description}",
        f"task        {episode.instruction}",
        "",
        *_sent(requests[0]),
        "",
        f"received ({', '.join(str(len(rows)) for rows in raw)} actions); the first action of each answer:",
        *_received(convention, episode, ticks, used),
        *policy.notices(),
    ]
    return PolicyCheck(
        lines=tuple(lines), suspicions=tuple(suspicions(convention, answers)),
        round_trip=round_trip(convention, episode.actions, episode.track), sheet=_sheet(convention, pictures, episode),
    )  # fmt: skip


def _upright(convention: Convention, key: str, picture: Picture) -> Picture:
    """Return a sent picture, the newest of a window, with its channels last; it stays turned as it was sent."""
    image = next(image for image in convention.images if image.key == key)
    picture = picture[-1] if convention.window > 1 else picture
    return np.moveaxis(picture, 0, 2) if image.layout == Layout.CHW else picture


def _sent(request: Mapping[str, object]) -> list[str]:
    lines = ["sent at the first tick:"]
    for key, value in request.items():
        if isinstance(value, np.ndarray) and value.dtype == np.uint8:
            text = f"picture {value.shape}, numbers from {value.min()} to {value.max()}, mean {value.mean():.0f}"
        elif isinstance(value, np.ndarray):
            text = f"{value.dtype} {value.shape} {np.array2string(value, precision=3, suppress_small=True)}"
        else:
            text = repr(value)[:120]
        lines.append(f"  {key:<36} {text}")
    return lines


def _received(convention: Convention, episode: ExpertEpisode, ticks: list[int], used: list[Floats]) -> list[str]:
    """Return a line for the first action of each answer, with the opening that the gripper's rule makes of it."""
    lines, experts = [], _experts(convention, episode)
    switch = GripperSwitch(convention.action.gripper.rule)
    for tick, rows in zip(ticks, used, strict=True):
        actions = decode_actions(convention, rows[: convention.chunking.rows_per_request(len(rows))])
        commanded = [switch.step(float(opening)) for opening in actions[:, -1]][0]
        rule = "" if abs(commanded - actions[0, -1]) < 0.005 else f" (the number alone says {actions[0, -1]:.2f})"
        shown = _in_units(convention, np.append(actions[0, :-1], commanded))
        lines.append(f"  tick {tick:>3}: {shown}{rule}; the expert: {experts[tick]}")
    return lines


def _experts(convention: Convention, episode: ExpertEpisode) -> list[str]:
    """Return the expert's actions in the convention's meaning; in RoboXim's own where it cannot express them."""
    source = ActionSemantics(rate_hz=convention.rate_hz)
    try:
        raw = from_actions(convention, episode.actions, episode.track, source=source)
        return [_in_units(convention, row) for row in decode_actions(convention, raw)]
    except RoboximError:  # the round trip says why
        return [f"{_motion(row[:3], row[3:6])}, {_opening(row[6])}" for row in episode.actions]


def _in_units(convention: Convention, action: Floats) -> str:
    meaning = convention.semantics
    if meaning.control.is_joint_space:
        unit = "rad/s" if meaning.control == "joint_velocity" else "rad"
        return f"joints {_numbers(action[:-1])} {unit}, {_opening(action[-1])}"
    return f"{_motion(action[:3], action[3:-1])}, {_opening(action[-1])}"


def _motion(position: Floats, rotation: Floats) -> str:
    return f"{_numbers(position)} m, {_numbers(rotation)} rad"


def _numbers(values: Floats) -> str:
    return "[" + " ".join(f"{value:+.3f}" for value in values) + "]"


def _opening(opening: float) -> str:
    return f"opening {opening:.2f}"


def _sheet(convention: Convention, pictures: Mapping[str, Picture], episode: ExpertEpisode) -> Image.Image:
    """Draw each sent picture above a sketch of what the family was trained on."""
    font = ImageFont.load_default(13)
    family = proven(convention)
    proof = family.proof if family else None
    sketch = Sketch(episode.scene, episode.states[0])
    width = sum(max(picture.shape[1], COLUMN_PX) for picture in pictures.values()) or COLUMN_PX
    tall = max((picture.shape[0] for picture in pictures.values()), default=0)
    below = tall + 3 * LABEL_PX
    sheet = Image.new("RGB", (width, 2 * below), "white")
    draw, left = ImageDraw.Draw(sheet), 0
    for image in convention.images:
        picture = pictures[image.key]
        size = (picture.shape[1], picture.shape[0])
        words = [image.key, f"camera {image.camera}, {size[0]} x {size[1]} px, {image.resize}"]
        words.append(f"sent {ORIENTATIONS[image.mirror, image.upside_down]}")
        sheet.paste(Image.fromarray(np.ascontiguousarray(picture)), (left, 3 * LABEL_PX))
        named = proof.views.get(image.key, "") if proof else ""
        camera = next(c for c in episode.scene.cameras if c.name == image.camera)
        camera = load_camera(named) if named else camera
        known = next((other for other in family.images if other.key == image.key), image) if family else image
        title = "This family was trained on such pictures" if proof else "No proof of this family; by its own fields"
        where = f"camera {named}" if named else (proof.trained_with if proof else "")
        label = [title, where, ORIENTATIONS[known.mirror, known.upside_down]]
        sheet.paste(
            sketch.draw(camera, size, mirror=known.mirror, upside_down=known.upside_down), (left, below + 3 * LABEL_PX)
        )
        for line, text in enumerate(words):
            draw.text((left + 3, line * LABEL_PX + 2), text, "black", font)
            draw.text((left + 3, below + line * LABEL_PX + 2), label[line], "black", font)
        left += max(size[0], COLUMN_PX)
    return sheet


def save_sheet(check: PolicyCheck, path: Path) -> None:
    """Write the sheet as a PNG file.

    Raises:
        OSError: When it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    check.sheet.save(path)
