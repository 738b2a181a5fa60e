"""Print the reference or the JSON Schema of a YAML file: task, suite, scene, camera, light, object, ..."""

from __future__ import annotations

import json
from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option


@strict.command()
@click.argument("kind", default="", metavar="KIND")
@click.option("--json", "as_json", is_flag=True, help="Print the JSON Schema, for editors.")
@option("out", help="File to write; the JSON Schema if it ends in .json.")
def command(kind: str, as_json: bool, out: Path | None) -> None:
    r"""Print what a YAML file may hold: keys, values, defaults and meaning. Without KIND, list the kinds.

    \b
    roboxim schema task
    roboxim schema cameras --json
    roboxim schema task --out task.schema.json
    """
    from roboxim_cli.schema import KINDS, json_schema, page, reference, schema_class
    from roboxim_core.errors import ConfigError
    from roboxim_core.whole_files import write_whole

    if not kind:
        for name, (folder, _) in KINDS.items():
            click.echo(f"{name:<11} {folder}")
        return
    as_json = as_json or (out is not None and out.suffix == ".json")
    if kind == "all" and as_json:
        raise ConfigError("each kind of file has a JSON Schema of its own; name one, e.g. roboxim schema task --json")
    text = (
        json.dumps(json_schema(schema_class(kind)), indent=2)
        if as_json
        else page()
        if kind == "all"
        else reference(kind)
    )
    if out is None:
        click.echo(text)
    else:
        write_whole(out, text if text.endswith("\n") else text + "\n")
        click.echo(f"wrote {out}")
