"""Replay failed planner requests, and draw them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict


@strict.group()
def command() -> None:
    """Replay failed planner requests, and draw them.

    A request that fails leaves a dump; the error message names it. DUMP is such a file, its name in the folder of
    dumps, or "latest". No running graph is needed.
    """


def _folder_option(function: Any) -> Any:
    return click.option(
        "--folder", type=click.Path(path_type=Path), help="Folder of dumps; default: the user's cache."
    )(function)


@command.command("dumps")
@_folder_option
def dumps(folder: Path | None) -> None:
    """List the dumps, newest first."""
    from roboxim_core.errors import ConfigError
    from roboxim_planner.dumps import dump_folder, list_dumps, read_dump

    found = list_dumps(folder or dump_folder())
    if not found:
        click.echo(f"no dumps in {folder or dump_folder()}")
    for path in found:
        try:
            outcome = str(read_dump(path).outcome)
        except ConfigError as error:  # e.g. of an older planner
            outcome = str(error)
        click.echo(f"{path}\n  {outcome}")


@command.command("replay", begins="planning")
@click.argument("dump")
@click.option("--no-deadline", is_flag=True, help="Ignore the request's deadline, e.g. after a timeout.")
@_folder_option
def replay(dump: str, no_deadline: bool, folder: Path | None) -> None:
    """Replay a dumped request. The exit code is 1 when the answer differs."""
    import time

    from roboxim_core.errors import PlannerError
    from roboxim_core.models.library import ModelLibrary
    from roboxim_planner.dumps import dump_folder, find_dump, read_dump

    path = find_dump(dump, folder or dump_folder())
    kept = read_dump(path)
    library = ModelLibrary()
    if library.digest(kept.query.robot) != kept.robot_digest:
        click.echo(f"the model of robot '{kept.query.robot}' has changed since", err=True)
    begun = time.perf_counter()
    again, answer = kept.run_again(library, deadline=not no_deadline)
    spent = 1000.0 * (time.perf_counter() - begun)
    click.echo(f"{path}\n  then: {kept.outcome}\n  now:  {again} ({spent:.0f} ms)")
    for plan in () if answer is None else answer.plans:
        click.echo(f"  {plan.route}, {plan.duration:.3f} s")
    if no_deadline:
        return
    if (again.error_code, again.error_msg, again.digest) != (
        kept.outcome.error_code, kept.outcome.error_msg, kept.outcome.digest,
    ):  # fmt: skip
        raise PlannerError("the answer differs; has the planner or a model changed?")
    click.echo("  the same answer")


@command.command("show", begins="drawing")
@click.argument("source")
@click.option(
    "--out", type=click.Path(path_type=Path), default="planner", show_default=True, help="Folder of pictures."
)
@_folder_option
def show(source: str, out: Path, folder: Path | None) -> None:
    r"""Draw scene and path, and the profiles of joint motion against their limits, as PNG files.

    \b
    roboxim planner show latest
    roboxim planner show request.yaml

    SOURCE is a dump, or a YAML file with the request of a planning service:

    \b
    service: plan_to_pose
    request: {start_state: {position: [0, -0.2, 0, -2.2, 0, 2.0, 0.785]}}
    target: {pose: {position: {x: 0.5, y: 0.2, z: 0.2}, orientation: {x: 1.0, w: 0.0}}}
    """
    from roboxim_core.models.library import ModelLibrary
    from roboxim_planner.dumps import SUFFIX, answered, dump_folder, find_dump, read_dump
    from roboxim_planner.pipeline import Planner

    library = ModelLibrary()
    if source.endswith((".yaml", ".yml")):
        query, planner = _query(Path(source), library)
        outcome, answer = answered(query, planner)
        name = Path(source).stem
    else:
        path = find_dump(source, folder or dump_folder())
        kept = read_dump(path)
        query, name = kept.query, path.name.removesuffix(SUFFIX)
        planner = Planner(library.robot(query.robot), kept.config)
        outcome, answer = kept.run_again(library)
    _draw(query, planner, outcome, answer, out, name)


def _draw(query: Any, planner: Any, outcome: Any, answer: Any, out: Path, name: str) -> None:
    from roboxim_planner.draw import draw_profiles, draw_scene

    click.echo(outcome)
    click.echo(draw_scene(query, planner, answer, out / f"{name}_scene.png", error=outcome.error_msg))
    if answer is not None and answer.plans:
        click.echo(draw_profiles(query, planner, answer.plans, out / f"{name}_profiles.png"))


def _query(path: Path, library: Any) -> tuple[Any, Any]:
    """Return the query in a request's YAML file, and the planner that receives it."""
    from roboxim_cli.messages import look_up, message_from_plain
    from roboxim_core.config import load_yaml
    from roboxim_core.errors import ConfigError, one_of
    from roboxim_planner.messages.queries import query_without_graph

    data = dict(load_yaml(path) or {})
    service = str(data.pop("service", ""))
    if service not in _SERVICES:
        raise ConfigError(f"{path}: 'service' must name a planning service; {one_of(_SERVICES, service)}")
    message = message_from_plain(look_up(f"roboxim_interfaces/srv/{_SERVICES[service]}", "srv").Request, data)
    return query_without_graph(service, message, library)


_SERVICES = {
    "plan_to_pose": "PlanToPose",
    "plan_to_joints": "PlanToJoints",
    "plan_cartesian": "PlanCartesian",
    "plan_sequence": "PlanSequence",
    "retime_path": "RetimePath",
}
