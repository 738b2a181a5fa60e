"""Check what this machine has, what is missing, and which parts work without it."""

from __future__ import annotations

import click

from roboxim_cli import strict
from roboxim_cli.options import print_json

_SIGNS = {
    "ok": ("ok      ", "green"),
    "absent": ("optional", "blue"),
    "warning": ("note    ", "yellow"),
    "missing": ("MISSING ", "red"),
}


@strict.command()
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(as_json: bool) -> None:
    """Check what this machine has, what is missing, how to install it, and which parts work without it.

    The exit code is 1 when a required part is missing.
    """
    from roboxim_bringup.doctor import examine

    findings = []
    for finding in examine():
        findings.append(finding)
        if not as_json:
            sign, colour = _SIGNS[finding.state]
            click.echo(f"{click.style(sign, fg=colour)}  {finding.name:<16} {finding.detail}")
            lines = (("for", finding.purpose), ("install" if finding.purpose else "do", finding.remedy))
            for label, text in (*lines, ("without it", finding.without)):
                if finding.state != "ok" and text:
                    click.echo(f"{'':<10}{'':<16} {label}: {text}")
    if as_json:
        print_json(findings)
    raise SystemExit(int(any(finding.state == "missing" for finding in findings)))
