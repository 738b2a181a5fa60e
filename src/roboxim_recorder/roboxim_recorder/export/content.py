"""Content of an export's steps: images, observed vectors, actions and rate, from the options or a convention.

In both cases the content has a `Convention`, which is written beside the dataset as ``convention.yaml``: a policy that
was trained on the dataset is evaluated by it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionSemantics, ControlMode, GripperConvention, Kinematics
from roboxim_core.conventions import (
    ActionOutput,
    ArmReadings,
    Chunking,
    Convention,
    GripperOutput,
    ImageInput,
    Layout,
    StateField,
    StateInput,
    StatePart,
    load_convention,
)
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.proprioception import STATE_FIELDS, Proprioception, ProprioField, component_names
from roboxim_core.rotation.representations import RotationRepresentation
from roboxim_datasets.dataset import UNUSED, Description, Features
from roboxim_datasets.episode import BETWEEN_ROBOTS, EXECUTED, Floats, ImageSize, RGBImage
from roboxim_datasets.rlds.episodes import USUAL_KEYS
from roboxim_recorder.acted import ACTED_BY, ACTORS
from roboxim_recorder.export.fit import (
    camera_sizes,
    firsts_of_robots,
    joint_names_of,
    one_semantics,
    require_common_space,
)
from roboxim_recorder.export.selection import Selection
from roboxim_recorder.export.sources import Source

PREFIX = "observation/"
"""Prefix of the request keys of observations; a dataset's keys omit it."""
_PARTS: Mapping[ProprioField, StatePart] = {
    ProprioField.TCP_POSITION: StatePart(field=StateField.TCP_POSITION),
    ProprioField.TCP_ROTATION_6D: StatePart(field=StateField.TCP_ROTATION, rotation=RotationRepresentation.ROTATION_6D),
    ProprioField.TCP_QUATERNION_XYZW: StatePart(
        field=StateField.TCP_ROTATION, rotation=RotationRepresentation.QUATERNION_XYZW
    ),
    ProprioField.TCP_EULER_XYZ: StatePart(
        field=StateField.TCP_ROTATION, rotation=RotationRepresentation.EULER_XYZ_EXTRINSIC
    ),
    ProprioField.JOINT_POSITIONS: StatePart(field=StateField.JOINT_POSITIONS),
    ProprioField.JOINT_VELOCITIES: StatePart(field=StateField.JOINT_VELOCITIES),
    ProprioField.GRIPPER_OPENING: StatePart(field=StateField.GRIPPER),
}


Flat = TypeVar("Flat", npt.NDArray[np.float32], npt.NDArray[np.uint16])


@dataclass(frozen=True, kw_only=True, eq=False)
class Content:
    """Content of the steps of an export."""

    convention: Convention
    """Meaning of images, state and actions; its rate is the export's."""
    named: bool
    """Whether the user named the convention; otherwise it was made from the options."""
    recorded: ActionSemantics
    """Meaning of the recorded actions."""
    actions: ActionSemantics
    """Meaning of the exported actions in RoboXim's units, before a named convention scales and orders them."""
    every: int
    """Recorded ticks per exported step."""
    robots: tuple[str, ...]
    """Ids of the robot models."""
    joint_names: tuple[str, ...]
    """Arm joints of the robots; empty: they have different ones."""
    keys: Mapping[str, str]
    """Camera to image key."""
    sizes: Mapping[str, ImageSize]
    """Camera to the size of its exported images."""
    depth: tuple[str, ...] = ()
    """Cameras whose depth images are exported."""
    segmentation: tuple[str, ...] = ()
    """Cameras whose segmentation images are exported."""
    names: Mapping[str, tuple[str, ...]]
    """Observed vector to the names of its components."""
    vectors: Mapping[str, Callable[[Proprioception], Floats]]
    """Observed vector to the function that makes it."""

    parts: Mapping[str, Mapping[str, tuple[int, int]]] = field(default_factory=dict)
    """``state`` and ``action`` to the convention's names of ranges of their components, if it names them."""

    @property
    def converts(self) -> bool:
        """Whether the exported actions differ from the recorded ones."""
        return self.named or self.every > 1 or bool(self.actions.differing(self.recorded))

    @property
    def semantics(self) -> ActionSemantics | None:
        """Meaning of the exported numbers; None: only the convention defines it (it scales or orders them)."""
        return _plain_semantics(self.convention, self.actions) if self.named else self.actions

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the exported action's components."""
        natural = self.actions.component_names(self.joint_names)
        output = self.convention.action
        if not self.named:
            return natural
        names = [UNUSED] * output.raw_size
        for place, name in zip(output.order or range(len(natural)), natural, strict=True):
            names[place] = name
        return tuple(names)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Parts that the export leaves out because the robots have different joints."""
        return () if self.joint_names else ("joint_positions",)

    def kinematics(self, robot: str) -> Kinematics | None:
        """Return a robot's kinematics, if actions change between joint space and end effector."""
        if self.actions.control.is_joint_space == self.recorded.control.is_joint_space:
            return None
        if robot not in self._kinematics:
            self._kinematics[robot] = ArmKinematics(ModelLibrary().robot(robot))
        return self._kinematics[robot]

    @cached_property
    def _kinematics(self) -> dict[str, Kinematics]:
        return {}

    @cached_property
    def _images(self) -> dict[str, ImageInput]:
        """Camera to the preparation of its images for training, without the steps that apply only at test time."""
        return {
            image.camera: replace(image, crop_area=1.0, jpeg_quality=0, layout=Layout.HWC)
            for image in self.convention.images
        }

    def instruction(self, text: str) -> str:
        """Return an instruction as it is exported: in the prompt of a named convention, if there is one."""
        return self.convention.prompt.text(text) if self.named else text

    def picture(self, camera: str, image: RGBImage) -> RGBImage:
        """Return a camera's image as it is exported."""
        return self._images[camera].prepare(image)

    def flat(self, camera: str, image: Flat) -> Flat:
        """Return a depth or segmentation image at the size of its camera's images, by the nearest pixels."""
        import cv2

        size = self.sizes[camera]
        if image.shape == (size.height, size.width):
            return image
        return np.asarray(
            cv2.resize(image, (size.width, size.height), interpolation=cv2.INTER_NEAREST_EXACT), image.dtype
        )

    def describe(self, sources: Sequence[Source]) -> Description:
        """Return the description of a dataset of these bags."""
        skills = tuple(sorted({source.info.task.skill for source in sources}))
        semantics, action = self.semantics, self.action_names
        meaning = f"{self.actions.control} in {self.actions.frame}, {self.actions.rotation}"
        gripper = (
            f", gripper {semantics.gripper}" if semantics else f", in the units of convention '{self.convention.name}'"
        )
        return Description(
            features=Features(
                cameras=self.sizes, keys=self.keys, depth=self.depth, segmentation=self.segmentation, action=action,
                vectors=self.names, signals={EXECUTED: action, **_signals(sources)},
                subtasks=any(source.step_words for source in sources),
            ),
            fps=self.convention.rate_hz,
            robot=BETWEEN_ROBOTS.join(self.robots),
            joint_names=self.joint_names,
            semantics=semantics,
            skills=skills,
            parts=self.parts,
            text=(
                f"{len(sources)} simulated episodes recorded with RoboXim; robot: {', '.join(self.robots)}; skills: "
                f"{', '.join(skills)}; {self.convention.rate_hz:g} Hz; actions: {meaning}{gripper}."
                + (f" Left out, since the robots' joints differ: {', '.join(self.left_out)}." if self.left_out else "")
            ),
        )  # fmt: skip


def _signals(sources: Sequence[Source]) -> dict[str, tuple[str, ...]]:
    """Return the signals of a dataset besides the executed actions."""
    return {ACTED_BY: ACTORS} if any(source.actors for source in sources) else {}


def content_of(sources: Sequence[Source], selection: Selection) -> Content:
    """Return the content of an export of bags.

    Raises:
        ConfigError: When there is no such convention.
        InvalidRequestError: On a camera, field or action that does not exist or does not fit the recording.
        RecorderError: ``EXPORT_REFUSED`` when the bags do not fit together or do not fit the rate.
    """
    if selection.convention:
        content = _by_named_convention(sources, load_convention(selection.convention))
    else:
        content = _by_options(sources, selection)
    if len(set(content.keys.values())) < len(content.keys) or content.names.keys() & set(content.keys.values()):
        raise InvalidRequestError(
            f"every camera needs a unique image key other than {' and '.join(sorted(content.names))}; got "
            f"{dict(content.keys)}"
        )
    for kind in ("depth", "segmentation"):
        _require_images(sources, kind, getattr(selection, kind), content.keys)
    return replace(content, depth=selection.depth, segmentation=selection.segmentation)


def _by_named_convention(sources: Sequence[Source], named: Convention) -> Content:
    robots, recorded = firsts_of_robots(sources), one_semantics(sources)
    joints = joint_names_of(robots.values())
    read = [part.field for state in named.states for part in state.parts]
    in_joints = StateField.JOINT_POSITIONS in read or StateField.JOINT_VELOCITIES in read
    require_common_space(robots, joints, {"actions": named.action.control.is_joint_space, "state": in_joints})
    convention = replace(named, rate_hz=named.rate_hz or recorded.rate_hz)
    if named.action.control.is_joint_space and named.action.joints != len(joints):
        raise InvalidRequestError(
            f"convention '{named.name}' commands {named.action.joints} joints, robot '{next(iter(robots))}' has "
            f"{len(joints)}"
        )
    keys = {image.camera: _last(image.key) for image in named.images}
    if len(keys) < len(named.images):
        raise InvalidRequestError(f"convention '{named.name}' names a camera twice; a dataset holds it once")
    camera_sizes(sources, tuple(keys), resized=True)
    names = {_last(state.key): state.names(joints) for state in named.states}
    vectors = {_last(state.key): _by_convention(state, convention) for state in named.states}
    if "state" not in names:  # trainers expect one vector of this name
        makers = list(vectors.values())
        names["state"] = tuple(part for parts in names.values() for part in parts) or component_names(STATE_FIELDS)
        vectors["state"] = _joined(makers) if makers else _by_fields(STATE_FIELDS)
    return Content(
        convention=convention, named=True, recorded=recorded, actions=convention.semantics,
        every=_ticks_per_step(recorded.rate_hz, convention.rate_hz), robots=tuple(robots), joint_names=joints,
        keys=keys, sizes={image.camera: ImageSize(height=image.height, width=image.width) for image in named.images},
        names=names, vectors=vectors, parts=_named_parts(named, names),
    )  # fmt: skip


def _by_options(sources: Sequence[Source], selection: Selection) -> Content:
    robots, recorded = firsts_of_robots(sources), one_semantics(sources)
    joints = joint_names_of(robots.values())
    every = _ticks_per_step(recorded.rate_hz, selection.rate_hz or recorded.rate_hz)
    slower = replace(
        recorded,
        rate_hz=recorded.rate_hz / every,
        max_translation_m=recorded.max_translation_m * every,
        max_rotation_rad=recorded.max_rotation_rad * every,
    )
    actions = _semantics_of(selection.actions, slower)
    keys = _image_keys(sources[0], selection)
    recorded_sizes = camera_sizes(sources, tuple(keys), resized=bool(selection.image_width))
    one = ImageSize(height=selection.image_height, width=selection.image_width)
    sizes = dict.fromkeys(keys, one) if selection.image_width else recorded_sizes
    fields = {"state": _fields(selection.state)}
    in_joints = bool({ProprioField.JOINT_POSITIONS, ProprioField.JOINT_VELOCITIES}.intersection(fields["state"]))
    require_common_space(robots, joints, {"actions": actions.control.is_joint_space, "state": in_joints})
    if joints:
        fields["joint_positions"] = (ProprioField.JOINT_POSITIONS,)
    return Content(
        convention=_made_convention(keys, sizes, recorded_sizes, fields, actions, len(joints)), named=False,
        recorded=recorded, actions=actions, every=every, robots=tuple(robots), joint_names=joints, keys=keys,
        sizes=sizes,
        names={name: component_names(parts, joints) for name, parts in fields.items()},
        vectors={name: _by_fields(parts) for name, parts in fields.items()},
    )  # fmt: skip


def _ticks_per_step(recorded_hz: float, wanted_hz: float) -> int:
    every = recorded_hz / wanted_hz
    if every < 1 or abs(every - round(every)) > 1e-9:
        raise RecorderError(
            f"the bags were recorded at {recorded_hz:g} Hz, not a whole multiple of {wanted_hz:g} Hz; record at "
            "such a rate ('roboxim generate --rate', or rate_hz of the task), or export at a rate that divides the "
            "recorded one",
            ErrorCode.EXPORT_REFUSED,
        )
    return round(every)


def _semantics_of(text: str, base: ActionSemantics) -> ActionSemantics:
    """Return the meaning that ``actions`` names; fields that it omits come from ``base``.

    Raises:
        InvalidRequestError: On an unknown word, or words that exclude each other.
    """
    kinds: dict[str, type[StrEnum]] = {
        name: type(getattr(base, name)) for name in ("control", "frame", "rotation", "gripper", "delta_base")
    }
    words = {str(value): name for name, kind in kinds.items() for value in kind if value != "none"}
    changes: dict[str, str] = {}
    for word in filter(None, (part.strip() for part in text.split(","))):
        key, equals, value = word.partition("=")
        if equals and key not in kinds:
            raise InvalidRequestError(f"actions: unknown field '{key}'; {one_of(kinds, key)}")
        if not equals and word not in words:
            raise InvalidRequestError(f"actions: unknown word '{word}'; {one_of(words, word)}")
        name = key if equals else words[word]
        if changes.setdefault(name, value if equals else word) != (value if equals else word):
            raise InvalidRequestError(f"actions: '{text}' gives {name} twice")
    given = tuple(changes)
    if changes.get("control", base.control) != base.control:
        fresh = ActionSemantics()
        restart = {name: getattr(fresh, name) for name in ("frame", "rotation", "delta_base")}
        base_fields = {n: v for n, v in restart.items() if n not in changes and getattr(base, n) == "none"}
        changes = {**base_fields, **changes}
    try:
        found = replace(base, **changes)  # type: ignore[arg-type]  # text becomes the enumeration
    except InvalidRequestError as error:
        raise InvalidRequestError(f"actions: {error}") from None
    for name in given:
        if getattr(found, name) != changes[name]:  # the control mode does not use it
            raise InvalidRequestError(
                f"actions: '{changes[name]}' has no meaning with control '{found.control}'; leave it out, or name "
                "another control"
            )
    return found


def _fields(text: str) -> tuple[ProprioField, ...]:
    if not text:
        return STATE_FIELDS
    try:
        return tuple(ProprioField(part.strip()) for part in text.split(","))
    except ValueError as error:
        raise InvalidRequestError(f"state: {error}") from None


def _last(key: str) -> str:
    """Return the dataset's name for ``key`` of a convention's request."""
    return key.rpartition("/")[2]


def _by_fields(fields: Sequence[ProprioField]) -> Callable[[Proprioception], Floats]:
    return lambda measured: measured.vector(fields)


def _joined(makers: Sequence[Callable[[Proprioception], Floats]]) -> Callable[[Proprioception], Floats]:
    return lambda measured: np.concatenate([make(measured) for make in makers])


def _named_parts(named: Convention, names: Mapping[str, tuple[str, ...]]) -> dict[str, dict[str, tuple[int, int]]]:
    """Return the ranges of components that a convention names separately, as GR00T's conventions do."""
    found: dict[str, dict[str, tuple[int, int]]] = {}
    if len(named.states) > 1:
        ends = np.cumsum([len(names[_last(state.key)]) for state in named.states]).tolist()
        starts = [0, *ends[:-1]]
        keys = [_last(state.key) for state in named.states]
        found["state"] = {key: (start, end) for key, start, end in zip(keys, starts, ends, strict=True)}
    if len(named.action.keys) == named.action.raw_size > 1:
        found["action"] = {_last(key): (at, at + 1) for at, key in enumerate(named.action.keys)}
    return found


def _by_convention(state: StateInput, convention: Convention) -> Callable[[Proprioception], Floats]:
    frames = convention.frames
    return lambda measured: np.asarray(state.rows(ArmReadings.of([measured]), frames)[0], np.float32)


def _image_keys(source: Source, selection: Selection) -> dict[str, str]:
    """Return camera to image key."""
    have = [camera.name for camera in source.info.scene.cameras]
    return dict(selection.cameras or {name: USUAL_KEYS.get(name, name) for name in have})


def _require_images(sources: Sequence[Source], kind: str, wanted: Sequence[str], keys: Mapping[str, str]) -> None:
    """Refuse depth or segmentation images of a camera that is not exported or that lacks them in a bag."""
    for name in wanted:
        if name not in keys:
            raise InvalidRequestError(f"{kind}: camera '{name}' is not exported; {one_of(keys, name)}")
        for source in sources:
            camera = next(c for c in source.info.scene.cameras if c.name == name)
            if not getattr(camera, kind):
                raise InvalidRequestError(
                    f"bag {source.path} has no {kind} images of camera '{name}'; record with '{kind}: true' in its YAML"
                )


def _plain_semantics(convention: Convention, actions: ActionSemantics) -> ActionSemantics | None:
    """Return the meaning of a convention's numbers if `ActionSemantics` can express it, else None."""
    output = convention.action
    scales = {output.translation_scale_m, output.rotation_scale_rad, output.joint_scale}
    natural = output.raw_size == output.natural_size and output.order in ((), tuple(range(output.natural_size)))
    if scales != {1.0} or output.normalisation or not natural or not convention.frames.is_plain:
        return None
    if actions.control == ControlMode.END_EFFECTOR_ABSOLUTE and any(convention.frames.base_origin_m):
        return None
    for gripper in GripperConvention:
        same = (gripper.open_value, gripper.closed_value) == (output.gripper.open, output.gripper.closed)
        if same and output.gripper.threshold is None:
            return replace(actions, gripper=gripper)
    return None


def _made_convention(
    keys: Mapping[str, str],
    sizes: Mapping[str, ImageSize],
    recorded: Mapping[str, ImageSize],
    fields: Mapping[str, Sequence[ProprioField]],
    actions: ActionSemantics,
    joints: int,
) -> Convention:
    """Return the convention that describes an export without a named one."""
    return Convention(
        name="export",
        description="How a policy that was trained on this dataset is asked, and what its answers mean.",
        rate_hz=actions.rate_hz,
        images=tuple(
            ImageInput(
                camera=camera, key=PREFIX + key, width=sizes[camera].width, height=sizes[camera].height,
                render_width=recorded[camera].width, render_height=recorded[camera].height,
            )
            for camera, key in keys.items()
        ),
        states=tuple(
            StateInput(key=PREFIX + name, parts=tuple(_PARTS[field] for field in parts))
            for name, parts in fields.items()
        ),
        action=ActionOutput(
            control=actions.control, frame=actions.frame, rotation=actions.rotation, delta_base=actions.delta_base,
            joints=joints, max_translation_m=actions.max_translation_m, max_rotation_rad=actions.max_rotation_rad,
            gripper=GripperOutput(open=actions.gripper.open_value, closed=actions.gripper.closed_value),
        ),
        chunking=Chunking(horizon=16),
    )  # fmt: skip
