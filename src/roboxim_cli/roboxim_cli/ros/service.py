"""List and call services."""

from __future__ import annotations

from typing import Any

import click

from roboxim_bringup.attach import attach_options, attached
from roboxim_cli import strict
from roboxim_cli.graph_names import add_names, complete
from roboxim_cli.options import POSITIVE


@strict.group()
def command() -> None:
    """List and call the services of a running graph."""


add_names(command, "service", hidden="Include hidden services, which implement actions.")


@command.command("find")
@click.argument("type_name", metavar="TYPE")
@attach_options
def find(type_name: str, run_id: str | None, domain: int | None) -> None:
    """List the services of a type."""
    from roboxim_cli.messages import full_name, look_up

    wanted = full_name(look_up(type_name, "srv"))
    with attached(run_id, domain) as peer:
        peer.settle()
        found = [name for name, types in peer.services().items() if wanted in types]
    for name in found:
        click.echo(name)


@command.command("call")
@click.argument("name", shell_complete=complete("services"))
@click.argument("words", nargs=-1, metavar="[TYPE] [YAML]")
@click.option(
    "--timeout",
    type=POSITIVE,
    default=120.0,
    show_default=True,
    help="Longest wait for the answer [s].",
)
@click.option("--full", is_flag=True, help="Do not shorten long arrays.")
@attach_options
def call(name: str, words: tuple[str, ...], timeout: float, full: bool, run_id: str | None, domain: int | None) -> None:
    r"""Call a service and print its answer as YAML.

    \b
    roboxim service call /sim/get_entities
    roboxim service call /planner/compute_fk '{state: {position: [0, -0.2, 0, -2.2, 0, 2.0, 0.785]}}'

    The type is optional. The exit code is 1 when the answer reports a failure.
    """
    type_name, text = split_type(words)
    from roboxim_bringup.attach import absolute
    from roboxim_cli.messages import full_name, look_up, message_from_plain, message_to_plain
    from roboxim_core.errors import ConfigError, RoboximError, SimError
    from roboxim_core.plain_data.yaml_text import dump, parse

    given = look_up(type_name, "srv") if type_name else None
    data = parse(text, source="request") if text else None
    request = message_from_plain(given.Request, data) if given else None
    with attached(run_id, domain) as peer:
        offered = peer.type_of("service", name)
        if given is not None and full_name(given) != offered:
            raise ConfigError(f"service '{absolute(name)}' has type {offered}, not {full_name(given)}")
        cls = given or look_up(offered, "srv")
        request = request or message_from_plain(cls.Request, data)
        response = peer.clients.call(cls, absolute(name), request, timeout_s=timeout, check=False)
    answer = message_to_plain(response, full=full)
    code = getattr(response, "error_code", 0)
    if not code or _has_payload(answer, message_to_plain(cls.Response(), full=full)):
        click.echo(dump(answer), nl=False)
    if code:
        raise RoboximError(f"{absolute(name)}: {response.error_msg}", code)
    result = getattr(response, "result", None)  # how simulation_interfaces says it
    if result is not None and hasattr(result, "RESULT_OK") and result.result != result.RESULT_OK:
        raise SimError(f"{absolute(name)}: {result.error_message}")


def _has_payload(answer: dict[str, Any], empty: dict[str, Any]) -> bool:
    """Return whether a failed call's answer holds more than its error, e.g. a partial path. An index of -1 is empty."""
    return any(
        value != empty[name] and value != -1
        for name, value in answer.items()
        if name not in ("error_code", "error_msg")
    )


def split_type(words: tuple[str, ...]) -> tuple[str, str]:
    """Split ``[TYPE] [YAML]`` words. A type has slashes and no spaces or braces."""
    import re

    if len(words) > 2:
        raise click.UsageError(f"expected at most a type and one YAML text, got {len(words)} words; quote the YAML")
    if len(words) == 2:
        return words[0], words[1]
    if not words:
        return "", ""
    return (words[0], "") if re.fullmatch(r"\w+(/\w+)+", words[0]) else ("", words[0])
