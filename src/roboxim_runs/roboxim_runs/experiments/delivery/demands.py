"""Reads what a cell demands of its episodes from its task, for the proofs of delivery.

What a task leaves unchanged, e.g. the light of its scene, is demanded as well. So cells that differ in a property can
be distinguished even if one of them does not name it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PHYSICAL
from roboxim_core.specs import CameraSpec, LookSpec
from roboxim_core.vision.cameras import load_camera
from roboxim_eval.experiments.proving.demand import Allowed, Demand, Value, View, plain_value
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.lights import LightsResetConfig
from roboxim_tasks.components.physics import BodyConfig, PhysicsResetConfig
from roboxim_tasks.config import TaskMix, task_mix
from roboxim_tasks.sampling.exclusions import taken
from roboxim_tasks.task_config import TaskConfig


@lru_cache(maxsize=64)
def task_mix_of(mix: str) -> TaskMix:
    """Return the task mix of a JSON text."""
    return task_mix(json.loads(mix))


@lru_cache(maxsize=64)
def demands_of(mix: str, words: str | None = None, latency_ticks: int = 0) -> dict[str, Demand]:
    """Return what each cell of a task mix demands.

    Args:
        mix: The mix as JSON text.
        words: What the policy must receive as instruction; none: the task's.
        latency_ticks: Ticks by which each of its answers must be late.
    """
    return demands_in(task_mix_of(mix), words, latency_ticks)


def demands_in(mix: TaskMix, words: str | None = None, latency_ticks: int = 0) -> dict[str, Demand]:
    """Return what each cell of a task mix demands; see `demands_of`."""
    return {
        key: demand_of(cell, words=words, latency_ticks=latency_ticks)
        for key, cell in zip(mix.keys, mix.cells, strict=True)
    }


def demand_of(config: TaskConfig, *, words: str | None = None, latency_ticks: int = 0) -> Demand:
    """Return what a task demands of its episodes.

    Args:
        config: A cell's task.
        words: What the policy must receive as instruction; none: the task's.
        latency_ticks: Ticks by which each of its answers must be late.
    """
    area = config.reset.get("interaction_area")
    areas = {}
    if area is not None:
        names = map(str, area.area.values) if area.area else area.areas
        boxes = tuple(_allowed(area.areas[name]) for name in names)
        areas = dict.fromkeys(area.roles, boxes)
    robot, cameras = config.reset.get("robot"), config.reset.get("cameras")
    physics: PhysicsResetConfig | None = config.reset.get("physics")
    scene = config.base_scene()
    return Demand(
        skill=config.skill,
        arm=scene.robot.model,
        arguments={name: _allowed(choice) for name, choice in config.arguments.items()},
        models={role: _allowed(thing.models) for role, thing in config.objects.items()},
        modifiers={
            role: _modifiers(thing.modifiers, physics.objects if physics else BodyConfig(), usual=_usual(thing.models))
            for role, thing in config.objects.items()
        },
        physics=dict.fromkeys(config.objects, _physics(physics.objects)) if physics else {},
        table_friction=_allowed(physics.table_friction) if physics else Allowed(values=(scene.table.friction,)),
        distractors=(config.distractors.minimum, config.distractors.maximum),
        others=_others(config, physics.distractors if physics else BodyConfig()),
        always=config.distractors.always,
        furniture={entity.name: entity.model for entity in scene.entities},
        areas=areas,
        start=_allowed(robot.position) if robot is not None and robot.joints is None else None,
        cameras={} if cameras is None else {name: _views(cameras, name) for name in cameras.names},
        shifts={} if cameras is None else {name: _allowed(choice) for name, choice in cameras.shift_m.items()},
        turned=() if cameras is None else tuple(cameras.turn_rad),
        look=_look_demand(config, scene.look),
        templates=() if config.templates is None else tuple(map(str, config.templates.drawable)),
        words=words,
        latency_ticks=latency_ticks,
    )


def _usual(models: Choice) -> dict[str, Allowed]:
    """Return the modifiers that some models take, as they are where a task does not name them: none or the default."""
    defaults: dict[str, dict[Value, None]] = {}
    for model in map(str, models.drawable):
        for kind, modifier in {**PHYSICAL, **_library().object_modifiers(model)}.items():
            defaults.setdefault(kind, {"": None})[plain_value(modifier.default)] = None
    return {kind: Allowed(values=tuple(values)) for kind, values in defaults.items()}


def _modifiers(
    modifiers: Mapping[str, Choice], body: BodyConfig, *, usual: Mapping[str, Allowed] | None = None
) -> dict[str, Allowed]:
    """Return the values of modifiers; of mass and friction those that the reset component ``physics`` draws anew."""
    found = {**(usual or {}), **{kind: _allowed(choice) for kind, choice in modifiers.items()}}
    drawn = (("mass", body.mass, body.mass_kg), ("friction", body.friction, body.friction_coefficient))
    for kind, factor, value in drawn:
        if factor is not None:
            found[kind] = _allowed(factor)
        elif value is not None:
            found.pop(kind, None)
    return found


def _physics(body: BodyConfig) -> dict[str, Allowed]:
    values = {"mass_kg": body.mass_kg, "friction_coefficient": body.friction_coefficient}
    return {kind: _allowed(choice) for kind, choice in values.items() if choice is not None}


def _others(config: TaskConfig, body: BodyConfig) -> dict[str, dict[str, Allowed]]:
    """Return the models that distractors are drawn from, each with the modifiers that it is drawn with."""
    found = {}
    for model in map(str, config.distractors.models.drawable if config.distractors.maximum else ()):
        known = _library().object_modifiers(model)
        drawn = {name: taken(name, choice, known) for name, choice in config.distractors.modifiers.items()}
        found[model] = _modifiers({name: choice for name, choice in drawn.items() if choice is not None}, body)
    return found


@lru_cache(maxsize=1)
def _library() -> ModelLibrary:
    return ModelLibrary()


def _allowed(choice: Choice | VectorChoice) -> Allowed:
    """Return the values of a choice; numbers of a range are vectors of one axis."""
    if isinstance(choice, VectorChoice):
        return Allowed(values=choice.values, lower=choice.lower or (), upper=choice.upper or ())
    if choice.values:
        return Allowed(values=tuple(plain_value(value) for value in choice.drawable))
    assert choice.lower is not None
    assert choice.upper is not None
    return Allowed(lower=(choice.lower,), upper=(choice.upper,))


def _views(cameras: Any, name: str) -> tuple[View, ...]:
    loaded = map(load_camera, _files(cameras, name))
    return tuple(View(parent=camera.parent, pose=camera.pose) for camera in loaded)


def _files(cameras: Any, name: str) -> tuple[str, ...]:
    """Return the files of ``config/cameras`` that a camera of the reset component ``cameras`` is drawn from."""
    return tuple(map(str, cameras.views[name].values)) if name in cameras.views else (name,)


def noise_of(camera: CameraSpec) -> tuple[float, ...]:
    """Return the strengths of a camera's photon noise, read-out noise and blur; its exposure is checked by itself."""
    return camera.noise.shot, camera.noise.read, camera.noise.blur_px


def look_of(look: LookSpec) -> dict[str, Value]:
    """Return the properties of light and surfaces that cells may demand."""
    found: dict[str, Value] = {
        "background": look.background, "background.backdrop": plain_value(look.backdrop),
        "light.ambient": plain_value(look.ambient), "light.number": float(len(look.lights)),
    }  # fmt: skip
    for surface in ("table", "floor", "wall"):
        material = getattr(look, surface)
        found |= {
            f"{surface}.color": plain_value(material.color), f"{surface}.texture": material.texture,
            f"{surface}.roughness": material.roughness,
        }  # fmt: skip
    if look.lights:
        light = look.lights[0]
        found |= {
            "light.intensity": light.intensity, "light.color": plain_value(light.color),
            "light.direction": plain_value(light.direction), "light.position": plain_value(light.position),
            "light.radius": light.radius,
        }  # fmt: skip
    return found


def _look_demand(config: TaskConfig, scene: LookSpec) -> dict[str, Allowed]:
    found = {name: Allowed(values=(value,)) for name, value in look_of(scene).items()}

    def demand(name: str, choice: Choice | VectorChoice | None) -> None:
        if choice is not None:
            found[name] = _allowed(choice)

    lights: LightsResetConfig | None = config.reset.get("lights")
    if lights is not None:
        for key in ("intensity", "color", "direction", "position", "radius", "ambient"):
            demand(f"light.{key}", getattr(lights, key))
        found["light.number"] = _rounded(_raised(lights.lamps.number, len(scene.lights)))
    if (surfaces := config.reset.get("surfaces")) is not None:
        for surface in ("table", "floor", "wall"):
            for key in ("color", "texture", "roughness"):
                demand(f"{surface}.{key}", getattr(getattr(surfaces, surface), key))
    if (background := config.reset.get("background")) is not None:
        demand("background", background.kind)
        demand("background.backdrop", background.backdrop)
    if (cameras := config.reset.get("cameras")) is not None:
        for name in cameras.names:
            loaded = [load_camera(file) for file in _files(cameras, name)]
            found[f"noise.{name}"] = Allowed(values=tuple(map(noise_of, loaded)))
            base = Choice(values=tuple(camera.noise.exposure_ev for camera in loaded))
            demand(f"exposure.{name}", base)
            if name in cameras.exposure_ev:
                demand(f"exposure.{name}", _raised(cameras.exposure_ev[name], loaded[0].noise.exposure_ev))
    return found


def _rounded(choice: Choice) -> Allowed:
    """Return the numbers that a choice gives after rounding."""
    ends = tuple(float(round(float(end))) for end in choice.ends)
    return Allowed(values=ends) if choice.values else Allowed(lower=ends[:1], upper=ends[1:])


def _raised(choice: Choice, by: float) -> Choice:
    if choice.values:
        return replace(choice, values=tuple(float(value) + by for value in choice.values))
    assert choice.lower is not None
    assert choice.upper is not None
    return replace(choice, lower=choice.lower + by, upper=choice.upper + by)
