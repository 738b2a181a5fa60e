"""Serve a policy, registered or your own; list the registered ones; list and explain conventions."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_bringup.attach import attach_options
from roboxim_cli import strict
from roboxim_cli.detach import stop_event
from roboxim_cli.named import Named
from roboxim_cli.options import is_given, option, parse_side
from roboxim_cli.ros.node import membership_options, run_node


@strict.group()
def command() -> None:
    """Serve a policy to the graph, list the registered ones, and explain conventions."""


@command.command("serve", begins="starting the policy")
@click.argument("spec", type=Named("policy"))
@click.option("--namespace", default="policy", show_default=True, help="Namespace of its services.")
@click.option(
    "-o",
    "--option",
    "options",
    multiple=True,
    metavar="KEY=VALUE",
    help="Argument of the policy's class; may be repeated.",
)
@click.option("--wire", default="", help="Serve other benchmarks instead of a graph: openpi, vla-eval or openvla.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen at, with --wire.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8000, show_default=True, help="Port, with --wire; 0: any."
)
@click.option("--all-users", is_flag=True, help="Let other users of this machine connect, too, with --wire.")
@click.option(
    "--convention", default="", help="Convention of requests and answers, with --wire; default: the policy's own."
)
@option(
    "size",
    default="256",
    metavar="PX",
    help="Side of the pictures of cameras for which the policy names none, with --wire.",
)
@membership_options
@attach_options
def serve(
    spec: str,
    namespace: str,
    options: tuple[str, ...],
    wire: str,
    host: str,
    port: int,
    all_users: bool,
    convention: str,
    size: str,
    params_files: tuple[str, ...],
    assignments: tuple[str, ...],
    open_network: bool,
    run_id: str | None,
    domain: int | None,
) -> None:
    r"""Serve a policy: a registered name, module:Class, or path/to/file.py:Class.

    \b
    roboxim policy serve my_module:MyPolicy --option checkpoint=/tmp/my.ckpt
    roboxim evaluate --policy my_module:MyPolicy

    With --wire, other benchmarks and other machines can ask the policy, without ROS:

    \b
    roboxim policy serve bc --option checkpoint=runs/bc --wire openpi
    roboxim evaluate --policy openpi --option url=ws://127.0.0.1:8000 --option convention=server --option version=bc
    """
    if wire:
        _serve_wire(
            spec, options, wire=wire, host=host, port=port, all_users=all_users, convention=convention,
            size=parse_side(size),
        )  # fmt: skip
        return
    if given := [name for name in ("host", "port", "all_users", "convention", "size") if is_given(name)]:
        from roboxim_core.errors import ConfigError

        named = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise ConfigError(f"{named}: for --wire alone; a policy in a graph does not use them")
    from roboxim_bringup.graph import PolicyLaunch
    from roboxim_bringup.parameters import parse_options

    launch = PolicyLaunch(spec=spec, namespace=namespace, options=parse_options(options))
    run_node(
        "", namespace="", params_files=params_files, assignments=assignments, open_network=open_network,
        run_id=run_id, domain=domain, policies=(launch,),
    )  # fmt: skip


def _serve_wire(
    spec: str, options: tuple[str, ...], *, wire: str, host: str, port: int, all_users: bool, convention: str,
    size: int,
) -> None:  # fmt: skip
    """Serve a policy over a wire until a signal arrives."""
    from roboxim_bringup.parameters import parse_options
    from roboxim_core.conventions import load_convention
    from roboxim_policies.base import load_policy
    from roboxim_policies.serving import policy_server

    given = parse_options(options)
    meaning = load_convention(convention) if convention else None
    server = policy_server(
        lambda: load_policy(spec, **given), wire, convention=meaning, size=size, host=host, port=port,
        all_users=all_users, log=lambda text: click.echo(text, err=True),
    )  # fmt: skip
    stop = stop_event()
    with server:
        click.echo(f"policy {server.sessions.description.name} at {server.url}, wire {wire}, ", nl=False)
        click.echo(f"convention {server.sessions.convention.name}; Ctrl-C stops it")
        if host not in ("127.0.0.1", "::1", "localhost"):
            click.echo("anybody who can reach this address can use the policy", err=True)
        stop.wait()


@command.command("new-server")
@option("out", default="openpi_server.py", help="File to write; it must not exist.")
def new_server(out: Path) -> None:
    r"""Write a policy server for a model that lives in another environment, to derive your model's server from.

    \b
    roboxim policy new-server --out openpi_server.py

    The file needs numpy, msgpack and websockets, and nothing of RoboXim.
    """
    from roboxim_policies.serving import stand_alone_server

    text = stand_alone_server().read_text()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("x") as file:
            file.write(text)
    except FileExistsError:
        raise click.UsageError(f"{out} exists; name another file with --out") from None
    click.echo(f"wrote {out}: derive a class from its Model, and call its serve()")


@command.command("check", begins="checking the policy")
@click.option("--policy", "spec", type=Named("policy"), required=True, help="A remote policy: openpi, vla_eval, ...")
@click.option(
    "-o", "--option", "options", multiple=True, metavar="KEY=VALUE",
    help="Argument of the policy, e.g. url=ws://host:8000; may be repeated.",
)  # fmt: skip
@click.option("--task", type=Named("task"), default="", help="Task of config/tasks, or a YAML file.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the episode.")
@click.option("--renderer", type=Named("renderer"), default="raster", show_default=True, help="Renderer.")
@option("out", default="policy_check.png", help="File of the pictures that were sent.")
def check(spec: str, options: tuple[str, ...], task: str, seed: int, renderer: str, out: Path) -> None:
    r"""Test a policy server in one episode before you evaluate it, and show suspicious findings.

    \b
    roboxim policy check --policy openpi --option url=ws://host:8000 --option convention=libero --option version=pi05

    The observations are those of an episode of the expert. The command writes the pictures as they were sent, shows the
    answers in metres, radians and opening, and sends the expert's own actions backwards and forwards through the
    convention. Ends with exit code 1 when something looks wrong.
    """
    from roboxim_core.errors import ConfigError
    from roboxim_runs.policies.specs import choose_policies

    (chosen,) = choose_policies([spec], (), options)
    if not chosen.is_remote:
        raise ConfigError(
            f"policy '{spec}' has no server; the check is for openpi, vla_eval, openvla, groot, xvla and remote"
        )

    from roboxim_policies.base import load_policy
    from roboxim_policies.remote import RemotePolicy
    from roboxim_runs.episodes.task_choice import task_text
    from roboxim_runs.policies.dry_run import check_policy, save_sheet

    policy = load_policy(chosen.spec, **chosen.options)
    assert isinstance(policy, RemotePolicy)
    with policy:
        found = check_policy(
            policy, task_text(task), seed=seed, renderer=renderer, on_step=lambda text: click.echo(text, err=True)
        )
    save_sheet(found, out)
    for line in found.lines:
        click.echo(line)
    click.echo(f"\nround trip  {found.round_trip}")
    click.echo(f"pictures    {out}")
    for text in found.suspicions:
        click.echo(f"suspicious  {text}")
    if not found.passed:
        raise click.exceptions.Exit(1)
    click.echo("nothing looks wrong")


@command.command("list")
def list_policies() -> None:
    """List the registered policies and their options."""
    from roboxim_cli.catalog import catalog

    for name, policy in catalog("policies")["policies"].items():
        click.echo(f"{name}  {policy['about']}")
        for key, default in policy["options"].items():
            click.echo(f"    {key}: {default}")


@command.command("conventions")
def list_conventions() -> None:
    """List the conventions: the requests to policies that were trained elsewhere, and the meaning of their answers.

    A convention with an invalid file is reported as an error at the end, after the others.
    """
    from roboxim_cli.catalog import catalog
    from roboxim_core.errors import ConfigError

    known = catalog("conventions")
    width = max(map(len, known["conventions"]), default=0)
    for name, entry in known["conventions"].items():
        click.echo(f"{name:<{width}}  {entry['rate']:>8}  {entry['control']:<20}  {entry['about']}")
    if known["broken"]:
        raise ConfigError("\n".join(known["broken"].values()))


@command.command("describe")
@click.argument("convention", type=Named("convention"))
def describe(convention: str) -> None:
    r"""Explain a convention: what the policy is sent, and what one action does.

    CONVENTION is a name (roboxim policy conventions lists them) or the path of a YAML file.

    \b
    roboxim policy describe libero
    roboxim policy describe exports/pick/convention.yaml
    """
    from roboxim_cli.catalog import catalog

    known = catalog("conventions")["conventions"]
    if convention in known:
        click.echo(known[convention]["described"])
        return
    from roboxim_core.conventions import load_convention
    from roboxim_core.conventions.words import described

    click.echo(described(load_convention(convention)))
