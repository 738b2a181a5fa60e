"""Serve a policy, registered or your own, or list the registered ones."""

from __future__ import annotations

import click

from roboxim_bringup.attach import attach_options
from roboxim_bringup.commands.node import membership_options, run_node
from roboxim_bringup.named import Named


@click.group()
def command() -> None:
    """Serve a policy to the graph, or list the registered ones."""


@command.command("serve")
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
@membership_options
@attach_options
def serve(
    spec: str,
    namespace: str,
    options: tuple[str, ...],
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
    """
    from roboxim_bringup.graph import PolicyLaunch
    from roboxim_bringup.parameters import parse_options

    launch = PolicyLaunch(spec=spec, namespace=namespace, options=parse_options(options))
    run_node(
        "", namespace="", params_files=params_files, assignments=assignments, open_network=open_network,
        run_id=run_id, domain=domain, policies=(launch,),
    )  # fmt: skip


@command.command("list")
def list_policies() -> None:
    """List the registered policies and their options."""
    from roboxim_bringup.catalog import catalog

    for name, policy in catalog()["policies"].items():
        click.echo(f"{name}  {policy['about']}")
        for option, default in policy["options"].items():
            click.echo(f"    {option}: {default}")
