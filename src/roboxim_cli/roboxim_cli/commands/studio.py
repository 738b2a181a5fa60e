"""Look at, edit and drive episodes and scenes in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from roboxim_core.errors import counted
from roboxim_core.plain_data.shell import shell_line

if TYPE_CHECKING:
    from roboxim_runs.policies.specs import ChosenPolicy
    from roboxim_studio.opening import Opened

from roboxim_bringup.attach import run_option
from roboxim_cli import strict
from roboxim_cli.detach import stop_event


@strict.command(begins="starting the studio")
@click.argument("what", default="", metavar="[RUN | BAG | DATASET | REPORT | TASK]")
@run_option
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port to listen at; 0: any free one.")
@click.option(
    "--open-network", is_flag=True,
    help="Let other machines connect, unencrypted; without it only this machine can. The address holds the secret.",
)  # fmt: skip
@click.option("--browser/--no-browser", default=True, help="Open the page in this machine's browser.")
@click.option(
    "--policy", "policies", multiple=True, metavar="NAME",
    help="A policy that \"what if\" offers besides the expert, as evaluate takes it; may be repeated.",
)  # fmt: skip
@click.option("--checkpoint", "checkpoints", multiple=True, metavar="DIR", help="Checkpoint of a policy, in order.")
@click.option(
    "--out", "html", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="Write the episode of a bag as one HTML file that plays offline, and end.",
)  # fmt: skip
def command(
    what: str, run_id: str | None, port: int, open_network: bool, browser: bool, policies: tuple[str, ...],
    checkpoints: tuple[str, ...], html: Path | None,
) -> None:  # fmt: skip
    r"""Open the studio: one page, served by this machine, without the internet.

    \b
    roboxim studio runs/demos                        # the episodes of a run
    roboxim studio runs/demos/episodes/demo-0-00000-0
    roboxim studio pick_up                           # a task
    roboxim studio                                   # the graph of the only 'roboxim up', else a task

    The printed address holds a secret: whoever has it can use the page. From another machine use an SSH tunnel:
    ssh -L 8080:127.0.0.1:8080 MACHINE roboxim studio --port 8080. Ctrl-C ends the studio.
    """
    import threading
    import webbrowser

    from roboxim_studio.acting.live import LiveGraph, choose_graph
    from roboxim_studio.opening import recognise
    from roboxim_studio.serving.access import Access
    from roboxim_studio.serving.site import Site

    opened = recognise(what)
    if html is not None:
        _share(opened, html)
        return
    chosen = _policies(policies, checkpoints)
    run, others = choose_graph(run_id) if run_id or not what else (None, ())
    stop = stop_event()
    graph = None if run is None else LiveGraph(run, others)
    site = Site(Access(open_network=open_network), port)
    click.echo(f"studio at {site.url}")
    if open_network:
        click.echo("from other machines: this machine's name instead of 127.0.0.1; traffic is not encrypted", err=True)
    if browser:
        threading.Thread(target=webbrowser.open, args=(site.url,), daemon=True).start()
    from roboxim_studio.first_view import first_view

    first = first_view(site, opened)
    from roboxim_studio.app import Studio  # most of the studio: a page loads and draws meanwhile

    with Studio(policies=chosen, graph=graph, site=site, first=first) as studio:
        if run is not None:
            named = ", ".join(f"{other.id} ({other.kind})" for other in others)
            click.echo(f"attached to the run {run.id}{f'; other runs: {named}' if named else ''}", err=True)
        studio.open(opened)
        stop.wait()
    if kept := studio.drive.kept:
        folder = studio.drive.bags.name
        click.echo(f"\n{counted(kept, 'episode')} kept in {folder}, {studio.drive.solved} solved")
        export = shell_line("roboxim", "export", "lerobot", folder, "--for", "act", "--out", f"{folder}-act")
        click.echo(f"next: {export}")


def _policies(names: tuple[str, ...], checkpoints: tuple[str, ...]) -> list[ChosenPolicy]:
    """Return the policies that were named."""
    if not names and not checkpoints:
        return []
    from roboxim_runs.policies.specs import choose_policies

    return choose_policies(names, checkpoints)


def _share(opened: Opened, html: Path) -> None:
    """Write an episode as HTML."""
    from roboxim_core.models.library import ModelLibrary
    from roboxim_studio.episode.film import read_film
    from roboxim_studio.opening import Kind
    from roboxim_studio.sharing import share

    if opened.kind != Kind.BAG or opened.path is None:
        raise click.UsageError("--out needs one bag, e.g. runs/demos/episodes/demo-0-00000-0")
    file = share(read_film(opened.path), ModelLibrary(), html)
    click.echo(f"{file}: {file.stat().st_size / 2**20:.1f} MiB")
