"""Say whether this version reads the runs, bags, cards and checkpoints of a folder."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import click

from roboxim_cli import strict


@strict.command(begins="comparing versions")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(folder: Path, as_json: bool) -> None:
    """Say whether this version reads the runs, bags, cards and checkpoints of FOLDER.

    Nothing is changed. The exit code is 1 when something is not read; each line then says why and what to do.
    """
    from roboxim_runs.storage.compatibility import examine

    findings = []
    for finding in examine(folder):
        findings.append(finding)
        if not as_json and not finding.readable:
            click.echo(f"{finding.kind} {finding.path}: {finding.detail}")
    unread = sum(not finding.readable for finding in findings)
    if as_json:
        click.echo(json.dumps([dataclasses.asdict(finding) for finding in findings], indent=2, default=str))
    else:
        kinds = sorted({finding.kind for finding in findings})
        counts = ", ".join(f"{kind} {sum(finding.kind == kind for finding in findings)}" for kind in kinds)
        click.echo(f"found {counts}: {'all are read' if not unread else f'{unread} are not read'}")
    raise SystemExit(int(unread > 0))
