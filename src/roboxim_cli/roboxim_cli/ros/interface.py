"""List and show message, service and action types."""

from __future__ import annotations

import click

from roboxim_cli import strict


@strict.group()
def command() -> None:
    """List and show the installed message, service and action types; needs no running graph."""


@command.command("list")
@click.option("-m", "--only-msgs", "kind", flag_value="msg", help="Messages only.")
@click.option("-s", "--only-srvs", "kind", flag_value="srv", help="Services only.")
@click.option("-a", "--only-actions", "kind", flag_value="action", help="Actions only.")
def list_interfaces(kind: str | None) -> None:
    """List the types."""
    from roboxim_cli.messages import interface_files

    for name in interface_files():
        if kind is None or f"/{kind}/" in name:
            click.echo(name)


@command.command("package")
@click.argument("package")
def package(package: str) -> None:
    """List the types of a package."""
    from roboxim_cli.messages import interface_files
    from roboxim_core.errors import ConfigError, one_of

    names = [name for name in interface_files() if name.startswith(f"{package}/")]
    if not names:
        packages = {name.split("/")[0] for name in interface_files()}
        raise ConfigError(f"no interface package '{package}'; {one_of(packages, package)}")
    for name in names:
        click.echo(name)


@command.command("show")
@click.argument("type_name", metavar="TYPE")
def show(type_name: str) -> None:
    """Print the definition of a type, with its comments."""
    from roboxim_cli.messages import show as text_of

    click.echo(text_of(type_name).rstrip())


@command.command("proto")
@click.argument("type_name", metavar="TYPE")
def proto(type_name: str) -> None:
    """Print a type's default values as YAML, to fill in for service call, send_goal or topic pub."""
    from roboxim_cli.messages import KINDS, look_up, prototype
    from roboxim_core.errors import ConfigError
    from roboxim_core.plain_data.yaml_text import dump

    parts = type_name.split("/")
    kinds = [parts[1]] if len(parts) == 3 and parts[1] in KINDS else list(KINDS)
    for kind in kinds:
        try:
            cls = look_up(type_name, kind)
        except ConfigError:
            if kind == kinds[-1]:
                raise
            continue
        part = {"msg": cls, "srv": getattr(cls, "Request", None), "action": getattr(cls, "Goal", None)}[kind]
        click.echo(dump(prototype(part)), nl=False)
        return
