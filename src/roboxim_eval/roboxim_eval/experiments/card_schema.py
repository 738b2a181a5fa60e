"""The JSON Schema of cards, from the dataclasses and the docstrings of their fields.

``roboxim_eval/schemas/*.schema.json`` are its output: ``python -m roboxim_eval.experiments.card_schema`` writes them.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from roboxim_core.config import LEFT_OUT
from roboxim_core.plain_data.field_docs import field_docs
from roboxim_eval.benchmark.card import BenchmarkCard
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.config import ExperimentConfig

DRAFT = "https://json-schema.org/draft/2020-12/schema"
CARDS = {"card": Card, "benchmark_card": BenchmarkCard}
"""Name of a schema to the class of its cards."""
SCALARS = {str: "string", int: "integer", float: "number", bool: "boolean", type(None): "null"}
OPEN = (ExperimentConfig,)
"""Classes whose fields are not part of the schema: the experiment file has its own checks."""


def schema_of(name: str) -> dict[str, Any]:
    """Return the schema of a kind of card.

    Args:
        name: ``card`` or ``benchmark_card``.
    """
    definitions: dict[str, Any] = {}
    root = _class_schema(CARDS[name], definitions)
    return {"$schema": DRAFT, "title": CARDS[name].__name__, **root, "$defs": definitions}


def _schema(kind: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a type of plain data."""
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return {}
    if kind in SCALARS:
        return {"type": SCALARS[kind]}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_schema(one, definitions) for one in arguments]}
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return {"type": "array", "items": _schema(arguments[0], definitions)}
        items = [_schema(one, definitions) for one in arguments]
        return {"type": "array", "prefixItems": items, "items": False, "minItems": len(items)}
    if origin in (dict, Mapping):
        return {"type": "object", "additionalProperties": _schema(arguments[1], definitions)}
    if kind in OPEN:
        return {"type": "object", "description": _first_line(kind)}
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        if kind.__name__ not in definitions:
            definitions[kind.__name__] = {}  # a class may name itself
            definitions[kind.__name__] = _class_schema(kind, definitions)
        return {"$ref": f"#/$defs/{kind.__name__}"}
    raise TypeError(f"no JSON Schema of {kind!r}")


def _class_schema(cls: type[Any], definitions: dict[str, Any]) -> dict[str, Any]:
    hints, docs = get_type_hints(cls), field_docs(cls)
    properties = {
        field.name: {**_schema(hints[field.name], definitions), "description": docs[field.name]}
        for field in dataclasses.fields(cls)
    }
    return {
        "type": "object", "description": _first_line(cls), "properties": properties,
        "required": [name for name in properties if name not in getattr(cls, LEFT_OUT, ())],
        "additionalProperties": False,
    }  # fmt: skip


def _first_line(cls: type[Any]) -> str:
    return (inspect.getdoc(cls) or "").partition("\n")[0]


def schema_text(name: str) -> str:
    """Return the text of a schema's file."""
    return json.dumps(schema_of(name), indent=2) + "\n"


def schema_file(name: str) -> Path:
    """Return the shipped file of a schema."""
    return Path(__file__).resolve().parents[1] / "schemas" / f"{name}.schema.json"


if __name__ == "__main__":
    for each in CARDS:
        schema_file(each).parent.mkdir(exist_ok=True)
        schema_file(each).write_text(schema_text(each))
