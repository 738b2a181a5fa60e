"""List the runs that are alive on this machine."""

from __future__ import annotations

import dataclasses
import json

import click


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(as_json: bool) -> None:
    """List the runs that are alive on this machine."""
    from roboxim_ros.runs import live_runs

    runs = live_runs()
    if as_json:
        click.echo(json.dumps([dataclasses.asdict(run) for run in runs], indent=2))
        return
    if not runs:
        click.echo("no run is alive; start one with: roboxim up")
        return
    rows = [("RUN", "KIND", "DOMAIN", "NETWORK", "PROCESSES", "STARTED (UTC)", "NAMESPACES")]
    for run in runs:
        network = "this user" if run.transport == "user" else "open"
        names = " ".join(name or "/" for name in run.namespaces)
        started = run.started.removesuffix("+00:00")
        rows.append((run.id, run.kind, str(run.domain), network, str(len(run.live_pids)), started, names))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        click.echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
