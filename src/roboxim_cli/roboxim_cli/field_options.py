"""Options of the command line and fields of a configuration: options made from fields, fields given by options."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Sequence
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


def training_fields(changes: Sequence[str], **given: Any) -> dict[str, Any]:
    """Return the fields of a training's configuration that the command line gives.

    Args:
        changes: The values of ``--set``.
        **given: Values of the options that have a field's name; None: not given.

    Raises:
        ConfigError: When a field is given twice, or a word is no ``FIELD=VALUE``.
    """
    from roboxim_bringup.parameters import parse_options

    fields = parse_options(changes)
    for name, value in given.items():
        if value is not None and name in fields:
            raise ConfigError(f"'{name}' is given by --{name} and by --set; leave one of them out")
        if value is not None:
            fields[name] = value
    return fields


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
