"""Serve the Gymnasium environments to programs of other Python environments."""

from __future__ import annotations

import click

from roboxim_cli import strict
from roboxim_cli.detach import stop_event


@strict.group()
def command() -> None:
    """Serve the Gymnasium environments to programs of other Python environments, e.g. LeRobot."""


@command.command("serve", begins="starting the environment")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen at.")
@click.option("--port", type=click.IntRange(0, 65535), default=8765, show_default=True, help="Port; 0: any.")
@click.option(
    "--most", "max_environments", type=click.IntRange(1, 64), default=8, show_default=True,
    help="Environments at the same time.",
)  # fmt: skip
@click.option("--all-users", is_flag=True, help="Let other users of this machine connect, too.")
def serve(host: str, port: int, max_environments: int, all_users: bool) -> None:
    r"""Serve environments over a WebSocket; each connection is one environment.

    \b
    roboxim gymnasium serve
    pip install plugins/lerobot_env_roboxim          # in LeRobot's Python
    lerobot-eval --env.type=roboxim --env.task=pick_cube --policy.path=...

    The environments of one server share a process. Start several servers, at several ports, to run them in parallel.
    """
    from roboxim_runs.environments.serving import EnvironmentServer

    stop = stop_event()
    with EnvironmentServer(
        host=host, port=port, max_environments=max_environments, all_users=all_users,
        log=lambda text: click.echo(text, err=True),
    ) as server:  # fmt: skip
        click.echo(f"environments at {server.url}; Ctrl-C stops the server")
        if host not in ("127.0.0.1", "::1", "localhost"):
            click.echo("anybody who can reach this address can run episodes", err=True)
        stop.wait()
