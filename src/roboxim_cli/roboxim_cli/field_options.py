"""Command-line options built from a configuration's fields: names, types, defaults and docstrings."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection
from typing import Any, Literal, get_args, get_origin, get_type_hints

import click

from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.field_docs import field_docs


def field_options(cls: type[Any], *, leave_out: Collection[str] = ()) -> list[click.Option]:
    """Return an option for each field of a configuration.

    Args:
        cls: A dataclass whose fields are ``int``, ``float``, ``str``, ``bool``, ``Literal`` or lists of words, all with
            defaults.
        leave_out: Fields that get no option.

    Raises:
        ConfigError: When a field is of another type.
    """
    hints, docs = get_type_hints(cls), field_docs(cls)
    return [
        _option(field.name, hints[field.name], field.default, docs.get(field.name, ""))
        for field in dataclasses.fields(cls)
        if field.name not in leave_out
    ]


def _option(name: str, kind: Any, default: Any, doc: str) -> click.Option:
    doc = re.sub(r"; see `[^`]*`", "", doc)  # a reference for readers of the code
    flag = f"--{name.replace('_', '-')}"
    if kind == tuple[str, ...]:
        return click.Option(
            [flag, name], multiple=True, metavar=name.upper().rstrip("S"), help=f"{doc} May be repeated."
        )
    if kind is bool:
        return click.Option([f"{flag}/--no-{flag[2:]}", name], default=default, show_default=True, help=doc)
    if get_origin(kind) is Literal:
        kind = click.Choice(get_args(kind))
    elif kind not in (int, float, str):
        raise ConfigError(f"field '{name}' is of type {kind}, which has no command-line option")
    return click.Option([flag, name], type=kind, default=default, show_default=default != "", help=doc)
