"""Reference and JSON Schema of every YAML file, from the dataclasses that read them."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.plain_data.field_docs import field_docs
from roboxim_core.poses import Pose

KINDS = {
    "task": ("config/tasks", "roboxim_tasks.task_config:TaskConfig"),
    "mix": ("config/tasks and config/suites", "roboxim_tasks.config:MixConfig"),
    "given": ("config/tasks, a task with a given scene", "roboxim_tasks.fixed_scene:FixedTask"),
    "scene": ("config/scenes", "roboxim_core.specs:SceneSpec"),
    "look": ("config/looks", "roboxim_core.vision.looks:LookSet"),
    "light": ("config/lights", "roboxim_core.vision.looks:Lighting"),
    "camera": ("config/cameras", "roboxim_core.vision.cameras:CameraConfig"),
    "object": ("config/objects", "roboxim_core.models.object_config:ObjectConfig"),
    "robot": ("config/robots", "roboxim_core.models.description:RobotModel"),
    "gripper": ("config/grippers", "roboxim_runs.robots.grippers:Gripper"),
    "convention": ("config/conventions", "roboxim_core.conventions.convention:Convention"),
    "response": ("config/responses", "roboxim_core.conventions.response:ControllerResponse"),
    "experiment": ("config/experiments", "roboxim_eval.experiments.config:ExperimentConfig"),
    "benchmark": ("config/benchmark", "roboxim_eval.benchmark.config:BenchmarkConfig"),
    "trainer": ("config/trainers", "roboxim_eval.experiments.trainers:TrainerConfig"),
    "bc": ("roboxim train bc --config", "roboxim_policies.bc.config:BCConfig"),
    "rt1s": ("roboxim train rt1s --config", "roboxim_policies.rt1s.config:RT1SConfig"),
    "act": ("roboxim train act --config", "roboxim_policies.act.config:ACTConfig"),
}
"""Kind of YAML file to the folder that has it, and the dataclass that reads it."""
SCALARS: dict[Any, tuple[str, str]] = {
    str: ("string", "text"), bool: ("boolean", "true or false"), int: ("integer", "whole number"),
    float: ("number", "number"), Path: ("string", "path"),
}  # fmt: skip
"""Type to its name in JSON Schema and in words."""

CHOICES = {"Choice": "value, list or range", "VectorChoice": "vector, list or box"}
"""Classes that have short forms, in words."""


def schema_class(kind: str) -> type[Any]:
    """Return the dataclass of a kind of file.

    Args:
        kind: One of `KINDS`, or its plural; ``suite`` is a mix.

    Raises:
        ConfigError: When there is no such kind.
    """
    name = {"suite": "mix", "suites": "mix"}.get(kind, kind)
    name = name if name in KINDS else name.removesuffix("es") if name.removesuffix("es") in KINDS else name.rstrip("s")
    if name not in KINDS:
        raise ConfigError(f"there is no YAML file '{kind}'; {one_of(KINDS, kind)}")
    module, _, cls = KINDS[name][1].partition(":")
    found: type[Any] = getattr(importlib.import_module(module), cls)
    return found


def json_schema(cls: type[Any]) -> dict[str, Any]:
    """Return the JSON Schema of a dataclass, for editors."""
    defs: dict[str, Any] = {}
    top = _typed(cls, defs)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **top, "$defs": defs}


def _object(cls: type[Any], defs: dict[str, Any]) -> dict[str, Any]:
    hints, docs = _hints(cls), field_docs(cls)
    properties = {}
    for field in dataclasses.fields(cls):
        typed = _typed(hints[field.name], defs)
        doc = {"description": docs[field.name]} if docs.get(field.name) else {}
        properties[field.name] = {**doc, **({"allOf": [typed]} if "$ref" in typed and doc else typed)}
    made: dict[str, Any] = {
        "type": "object", "description": _first(cls), "properties": properties, "additionalProperties": False,
        "required": [field.name for field in dataclasses.fields(cls) if _is_required(field)],
    }  # fmt: skip
    if cls is Pose:
        properties["rpy_deg"] = {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}
        made["required"] = []
    return made | _special(cls, properties, defs)


def _special(cls: type[Any], properties: dict[str, Any], defs: dict[str, Any]) -> dict[str, Any]:
    """Complete the schema of a task or a step with the sections of its skill, and a task's with those of its reset."""
    from roboxim_tasks.components import COMPONENTS
    from roboxim_tasks.skills import SKILLS
    from roboxim_tasks.task_config import StepConfig, TaskConfig

    if cls not in (TaskConfig, StepConfig):
        return {}
    properties["skill"] = {"anyOf": [{"enum": list(SKILLS)}, {"type": "string", "pattern": r"\.py:\w+$"}]}
    rules: list[dict[str, Any]] = []
    for name in SKILLS:
        typed = _typed(SKILLS[name].Parameters, defs)
        rules.append(
            {
                "if": {"properties": {"skill": {"const": name}}},
                "then": {"properties": {"parameters": typed, "lenient": typed}},
            }
        )
    if cls is StepConfig:
        return {"allOf": rules}
    sections = {name: _typed(COMPONENTS[name].Config, defs) for name in COMPONENTS}
    properties["reset"] |= {"properties": sections, "additionalProperties": False}
    properties["skill"]["anyOf"].append({"type": "string", "pattern": r"\+"})
    named = {"anyOf": [{"type": "object", "required": [key]} for key in ("skill", "steps")]}
    return {"allOf": [*rules, named], "required": []}


def _typed(kind: Any, defs: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a type; a dataclass is named in ``$defs``."""
    origin, arms = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        if kind.__name__ not in defs:
            defs[kind.__name__] = {}  # a class may contain itself
            defs[kind.__name__] = _object(kind, defs)
        found: dict[str, Any] = {"$ref": f"#/$defs/{kind.__name__}"}
        if hasattr(kind, "from_short"):
            return {"anyOf": [found, {"type": ["string", "number", "boolean", "array"]}]}
        return found
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return {"enum": [str(item) for item in kind]}
    if kind in SCALARS:
        return {"type": SCALARS[kind][0]}
    if origin is Literal:
        return {"enum": list(arms)}
    if origin in (Union, type(int | str)):
        arms = tuple(arm for arm in arms if arm is not type(None))
        several = [_typed(arm, defs) for arm in arms]
        return {"anyOf": [*several, {"type": "null"}]} if len(arms) < len(get_args(kind)) else {"anyOf": several}
    if origin in (tuple, list, Sequence, frozenset):
        if origin is tuple and Ellipsis not in arms:
            return {"type": "array", "prefixItems": [_typed(arm, defs) for arm in arms], "minItems": len(arms)}
        listed = {"type": "array", "items": _typed(arms[0], defs)}
        return {"anyOf": [listed, {"type": "string"}]} if arms[0] is str else listed
    if origin in (dict, Mapping):
        return {"type": "object", "additionalProperties": _typed(arms[1], defs)}
    return {}


def reference(kind: str) -> str:
    """Return the reference of a kind of file as Markdown: a table for it and for each class inside it.

    Raises:
        ConfigError: When there is no such kind.
    """
    from roboxim_tasks.components import COMPONENTS
    from roboxim_tasks.skills import SKILLS

    cls = schema_class(kind)
    name = next(name for name, (_, path) in KINDS.items() if path.endswith(f":{cls.__name__}"))
    lines = [f"## {name}", "", f"{_first(cls)} Files: `{KINDS[name][0]}`.", ""]
    pending, done = [("", cls)], set()
    if name == "task":
        pending += [(f"reset.{key}", COMPONENTS[key].Config) for key in COMPONENTS]
        pending += [(f"parameters of {key}", SKILLS[key].Parameters) for key in SKILLS]
    while pending:
        title, one = pending.pop(0)
        if one in done or not dataclasses.fields(one):
            continue
        done.add(one)
        heading = f"{name}: {CHOICES.get(one.__name__, title)}"
        lines += [f"### {heading}", "", _first(one), ""] if title else []
        lines += [*_table(one), ""]
        inner = [(field.name, kind) for field in dataclasses.fields(one) for kind in _inside(_hints(one)[field.name])]
        pending += [(f"{title}.{key}".lstrip(".") if title else key, kind) for key, kind in inner]
    return "\n".join(lines)


def _table(cls: type[Any]) -> Iterator[str]:
    yield "| key | value | default | meaning |"
    yield "| --- | --- | --- | --- |"
    hints, docs = _hints(cls), field_docs(cls)
    for field in dataclasses.fields(cls):
        cells = (f"`{field.name}`", _words(hints[field.name]), _default(field), docs.get(field.name, ""))
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _words(kind: Any) -> str:
    """Return a type in words."""
    origin, arms = get_origin(kind), get_args(kind)
    if kind in SCALARS:
        return SCALARS[kind][1]
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return ", ".join(f"`{item}`" for item in kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return CHOICES.get(kind.__name__, "mapping")
    if origin is Literal:
        return ", ".join(f"`{item}`" for item in arms)
    if origin in (Union, type(int | str)):
        if set(arms) == {str, int, float, bool}:
            return "value"
        return " or ".join(dict.fromkeys(_words(arm) for arm in arms if arm is not type(None)))
    if origin is tuple and Ellipsis not in arms:
        return f"{len(arms)} numbers" if set(arms) <= {float, int} else f"list of {len(arms)}"
    if origin in (tuple, list, Sequence, frozenset):
        return f"list of {_plural(_words(arms[0]))}"
    if origin in (dict, Mapping):
        return f"mapping to {_words(arms[1])}"
    return "any"


def _plural(words: str) -> str:
    simple = {"text": "texts", "number": "numbers", "whole number": "whole numbers", "mapping": "mappings"}
    return simple.get(words, words)


def _default(field: dataclasses.Field[Any]) -> str:
    if _is_required(field):
        return "required"
    factory = field.default_factory
    value: Any = factory() if factory is not dataclasses.MISSING else field.default
    if value is None or value in ((), "", {}) or dataclasses.is_dataclass(value):
        return ""
    plain = to_plain(value)
    if isinstance(plain, list) and not any(map(dataclasses.is_dataclass, value)):
        plain = ", ".join(map(str, plain))
    text = str(plain).lower() if isinstance(plain, bool) else str(plain)
    return f"`{text}`" if len(text) < 50 else "see a file"


def _inside(kind: Any) -> Iterator[type[Any]]:
    """Yield the dataclasses in a type that have a table of their own."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        yield kind
    for arm in get_args(kind):
        yield from _inside(arm)


def _hints(cls: type[Any]) -> dict[str, Any]:
    return get_type_hints(cls)


def _is_required(field: dataclasses.Field[Any]) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _first(cls: type[Any]) -> str:
    """Return the first paragraph of a class's docstring."""
    return " ".join((inspect.getdoc(cls) or "").partition("\n\n")[0].replace("``", "`").split())


def page() -> str:
    """Return the page of all kinds of files for the documentation."""
    head = """# YAML files

`roboxim schema` prints this reference, `roboxim schema task --json` a JSON Schema for editors. This page is generated:
`roboxim schema all --out docs/reference/yaml.md`; a test compares it with the code.

For VS Code's YAML extension, write `roboxim schema task --out task.schema.json` and begin a task's file with
`# yaml-language-server: $schema=./task.schema.json`.

A key that a file leaves out has its default. A *value, list or range* is `0.6`, `[0.6, 0.8]`,
`{lower: 0.6, upper: 0.8}` or `{values: [0.6, 0.8], order: in_order}`; the same with vectors and boxes.
Own files are found in the folders of `ROBOXIM_CONFIG_PATH`.
"""
    return "\n".join([head, *(reference(kind) for kind in KINDS)]).rstrip("\n") + "\n"
