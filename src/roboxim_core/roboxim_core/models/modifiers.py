"""Modifiers of objects: ``color``, ``material``, ``size`` (a word) and ``scale`` (a number).

A modifier that a model does not list is refused: a task that asks for a green apple must not silently get a red one.
Every object also takes ``mass`` and ``friction``, invisible factors for randomising the physics.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.description import GraspAnnotation, LinkModel, ObjectModel, Visual
from roboxim_core.poses import Pose, Vec3
from roboxim_core.specs import RGB, MaterialSpec, Scalar

PALETTE: Mapping[str, RGB] = MappingProxyType(
    {
        "red": (0.76, 0.10, 0.09),
        "green": (0.13, 0.55, 0.19),
        "blue": (0.10, 0.27, 0.75),
        "yellow": (0.93, 0.77, 0.10),
        "orange": (0.93, 0.45, 0.06),
        "purple": (0.45, 0.17, 0.60),
        "pink": (0.93, 0.50, 0.65),
        "cyan": (0.15, 0.68, 0.75),
        "brown": (0.38, 0.22, 0.12),
        "tan": (0.80, 0.60, 0.38),
        "white": (0.90, 0.90, 0.88),
        "black": (0.07, 0.07, 0.08),
        "gray": (0.45, 0.46, 0.47),
    }
)
"""The colours that instructions name, in sRGB."""


@dataclass(frozen=True, kw_only=True)
class Finish:
    """Changes by a ``material`` modifier."""

    surface: MaterialSpec
    """Look, with the material's natural colour; a ``color`` modifier replaces the colour."""
    density: float
    """Mass relative to plastic; objects count as hollow, so that the gripper can still lift a metal one."""
    friction: float
    """Lateral friction coefficient."""


FINISHES: Mapping[str, Finish] = MappingProxyType(
    {
        "plastic": Finish(surface=MaterialSpec(color=(0.72, 0.73, 0.74), roughness=0.4), density=1.0, friction=0.8),
        "wooden": Finish(
            surface=MaterialSpec(color=(0.80, 0.60, 0.38), roughness=0.65, texture="wood_grain"),
            density=1.1,
            friction=0.8,
        ),
        "metal": Finish(
            surface=MaterialSpec(color=(0.90, 0.90, 0.89), metallic=1.0, roughness=0.25, texture="brushed_metal"),
            density=2.0,
            friction=0.7,
        ),
        "ceramic": Finish(surface=MaterialSpec(color=(0.90, 0.89, 0.86), roughness=0.2), density=1.5, friction=0.7),
        "rubber": Finish(surface=MaterialSpec(color=(0.13, 0.13, 0.14), roughness=0.85), density=1.2, friction=1.0),
    }
)
"""The materials that instructions name."""

KINDS = ("color", "material", "size", "scale")


@dataclass(frozen=True, kw_only=True)
class ModifierModel:
    """Allowed values of one modifier of an object."""

    default: str | float
    """Default value."""
    choices: tuple[str, ...] = ()
    """Allowed colours or materials; empty: all of them."""
    factors: dict[str, float] = field(default_factory=dict)
    """For ``size``: word to uniform factor, e.g. ``{small: 0.8, large: 1.2}``."""
    lower: float = 1.0
    """For ``scale``: smallest factor."""
    upper: float = 1.0
    """For ``scale``: largest factor."""

    def check(self, source: str, kind: str, value: Scalar) -> None:
        """Refuse a value that is not allowed.

        Raises:
            ConfigError: The message lists the allowed values.
        """
        if kind == "scale" or kind in PHYSICAL:
            if isinstance(value, bool) or not isinstance(value, float | int) or not self.lower <= value <= self.upper:
                raise ConfigError(
                    f"{source}: {kind} must be a number from {self.lower:g} to {self.upper:g}, got {value!r}"
                )
        elif value not in self.words(kind):
            raise ConfigError(f"{source}: unknown {kind} '{value}'; {one_of(self.words(kind), str(value))}")

    def words(self, kind: str) -> tuple[str, ...]:
        """Return the words that a modifier of a kind other than ``scale`` allows."""
        if kind == "size":
            return tuple(self.factors)
        return self.choices or tuple(PALETTE if kind == "color" else FINISHES)

    @property
    def colors(self) -> tuple[str, ...]:
        """Allowed colours of a ``color`` modifier."""
        return self.words("color")

    def check_itself(self, kind: str) -> None:
        """Refuse an inconsistent modifier.

        Raises:
            ConfigError: The message says what is expected.
        """
        if kind not in KINDS:
            raise ConfigError(f"unknown modifier '{kind}'; {one_of(KINDS, kind)}")
        known = tuple(FINISHES if kind == "material" else PALETTE)
        for choice in self.choices:
            if choice not in known:
                raise ConfigError(f"unknown {kind} '{choice}' among the choices; {one_of(known, choice)}")
        if min((self.lower, *self.factors.values())) <= 0:
            raise ConfigError(f"factors of '{kind}' must be > 0")
        self.check("default", kind, self.default)


PHYSICAL: Mapping[str, ModifierModel] = MappingProxyType(
    {
        "mass": ModifierModel(default=1.0, lower=0.2, upper=5.0),
        "friction": ModifierModel(default=1.0, lower=0.2, upper=2.0),
    }
)
"""Factors on the mass of every link and on the lateral friction, which every object takes."""


def color_word(modifiers: Mapping[str, ModifierModel], given: Mapping[str, Scalar]) -> str:
    """Return the word for an object's colour; empty: it has none.

    It is the given colour, else the model's default. An object of another material without a given colour has that of
    the material, and the word of the nearest colour of the palette: rubber is black, wood tan.

    Args:
        modifiers: The object's modifiers by kind.
        given: Values by kind.
    """
    if "color" in given:
        return str(given["color"])
    material = given.get("material")
    if "material" in modifiers and material not in (None, modifiers["material"].default):
        natural = FINISHES[str(material)].surface.color
        return min(PALETTE, key=lambda word: math.dist(PALETTE[word], natural))
    return str(modifiers["color"].default) if "color" in modifiers else ""


def modified(
    model: ObjectModel, modifiers: Mapping[str, ModifierModel], given: Mapping[str, Scalar], source: str
) -> ObjectModel:
    """Return an object with modifiers applied.

    Args:
        model: The object as its file describes it.
        modifiers: The object's modifiers by kind.
        given: Values by kind; those left out take their default.
        source: Name of the object, for messages.

    Raises:
        ConfigError: On a modifier or value that the object does not allow; the message lists the allowed ones.
    """
    for kind, value in given.items():
        allowed = modifiers.get(kind) or PHYSICAL.get(kind)
        if allowed is None:
            raise ConfigError(f"{source} has no modifier '{kind}'; {one_of((*modifiers, *PHYSICAL), kind)}")
        allowed.check(source, kind, value)
    values = {kind: modifier.default for kind, modifier in modifiers.items()} | dict(given)
    material = values.get("material")
    changed = material is not None and material != modifiers["material"].default
    if changed:
        model = _made_of(model, FINISHES[str(material)], FINISHES[str(modifiers["material"].default)])
    if "color" in given or ("color" in values and not changed):
        model = _tinted(model, PALETTE[str(values["color"])])
    factor = float(values.get("scale", 1.0))
    if "size" in values:
        factor *= modifiers["size"].factors[str(values["size"])]
    if factor != 1.0:
        model = scaled(model, factor)
    return _weighted(model, float(given.get("mass", 1.0)), float(given.get("friction", 1.0)))


def _weighted(model: ObjectModel, mass: float, friction: float) -> ObjectModel:
    if mass != 1.0:
        model = replace(model, links=tuple(replace(link, mass=link.mass * mass) for link in model.links))
    if friction != 1.0:
        lateral = model.friction.lateral * friction
        model = replace(model, friction=replace(model.friction, lateral=lateral))
    return model


def _made_of(model: ObjectModel, finish: Finish, usual: Finish) -> ObjectModel:
    def covered(visual: Visual) -> Visual:
        return replace(visual, material=finish.surface) if visual.tinted else visual

    links = tuple(
        replace(link, mass=link.mass * finish.density / usual.density, visual=tuple(map(covered, link.visual)))
        for link in model.links
    )
    return replace(model, links=links, friction=replace(model.friction, lateral=finish.friction))


def _tinted(model: ObjectModel, color: RGB) -> ObjectModel:
    def painted(visual: Visual) -> Visual:
        return replace(visual, material=replace(visual.material, color=color)) if visual.tinted else visual

    links = tuple(replace(link, visual=tuple(map(painted, link.visual))) for link in model.links)
    return replace(model, links=links)


def scaled(model: ObjectModel, factor: float) -> ObjectModel:
    """Scale an object by a uniform factor at constant density."""

    def times(vector: Vec3) -> Vec3:
        x, y, z = vector
        return x * factor, y * factor, z * factor

    def moved(pose: Pose) -> Pose:
        return replace(pose, position=times(pose.position))

    def link_of(link: LinkModel) -> LinkModel:
        collision = tuple(
            replace(s, size=tuple(v * factor for v in s.size), scale=s.scale * factor, pose=moved(s.pose))
            for s in link.collision
        )
        visual = tuple(replace(v, scale=times(v.scale), pose=moved(v.pose)) for v in link.visual)
        return replace(link, mass=link.mass * factor**3, collision=collision, visual=visual)

    def grasps_of(grasps: tuple[GraspAnnotation, ...]) -> tuple[GraspAnnotation, ...]:
        return tuple(
            replace(
                grasp, pose=moved(grasp.pose), width_m=grasp.width_m * factor,
                opening_m=grasp.opening_m + grasp.width_m * max(factor - 1, 0),  # the same room beside a larger object
            )
            for grasp in grasps
        )  # fmt: skip

    joints = []
    for joint in model.joints:
        length = factor if joint.kind == "prismatic" else 1.0
        joints.append(replace(joint, pose=moved(joint.pose), lower=joint.lower * length, upper=joint.upper * length))
    return replace(
        model,
        links=tuple(map(link_of, model.links)),
        joints=tuple(joints),
        grasps=grasps_of(model.grasps),
        regions=tuple(replace(r, pose=moved(r.pose), size=times(r.size)) for r in model.regions),
        handles=tuple(replace(h, pose=moved(h.pose), grasps=grasps_of(h.grasps)) for h in model.handles),
        press_points=tuple(
            replace(p, pose=moved(p.pose), pressed_at=p.pressed_at * factor) for p in model.press_points
        ),
        toppled=tuple(map(moved, model.toppled)),
        size=times(model.size),
        rest_height=model.rest_height * factor,
    )
