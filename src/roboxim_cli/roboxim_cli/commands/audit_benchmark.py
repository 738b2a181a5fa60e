"""Probe a Gymnasium environment for faults that make its success rates wrong."""

from __future__ import annotations

from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import option, print_json
from roboxim_core.errors import counted


def _options(words: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of an environment."""
    from roboxim_core.plain_data import yaml_text

    if wrong := [word for word in words if not word.partition("=")[0].isidentifier() or "=" not in word]:
        raise click.UsageError(f"--option must be KEY=VALUE, e.g. env_name=reach-v3; got {wrong[0]!r}")
    return {
        key: yaml_text.parse(value, source=f"--option {key}")
        for key, _, value in (word.partition("=") for word in words)
    }


@strict.command(begins="auditing the benchmark")
@click.argument("environment")
@click.option(
    "--seeds", type=click.IntRange(2), default=8, show_default=True, help="Number of seeds whose scenes are compared."
)
@click.option("--steps", type=click.IntRange(2), default=20, show_default=True, help="Number of steps of a probe.")
@option("episodes", default=20, help="Number of complete episodes of each way to act.")
@click.option(
    "--max-steps",
    "limit",
    type=click.IntRange(2),
    default=1000,
    show_default=True,
    help="Steps after which an episode is given up.",
)
@click.option(
    "--solver", default="", metavar="FILE.py:NAME",
    help="Function that returns a policy, a function of observation and instruction; for the checks of words, replay "
    "and rewards.",
)  # fmt: skip
@click.option("--option", "options", multiple=True, metavar="KEY=VALUE", help="Option of the environment, YAML.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    environment: str, seeds: int, steps: int, episodes: int, limit: int, solver: str, options: tuple[str, ...],
    as_json: bool,
) -> None:  # fmt: skip
    r"""Probe a Gymnasium ENVIRONMENT for faults that make its success rates wrong or not repeatable.

    \b
    roboxim audit-benchmark roboxim/PickCube-v0 --episodes 3
    roboxim audit-benchmark gymnasium_robotics:FetchReach-v4 --max-steps 50

    ENVIRONMENT is a registered id, or MODULE:ID with the module that registers it. The exit code is 1 when a fault was
    found.
    """
    from roboxim_core.errors import ConfigError, PolicyError
    from roboxim_policies.base import find_policy
    from roboxim_runs.environments.benchmark_audit import AuditConfig, audit_benchmark, environment_maker

    if solver and ":" not in solver:
        raise click.UsageError(f"--solver must be FILE.py:NAME or MODULE:NAME, with a function's name; got '{solver}'")
    config = AuditConfig(seeds=seeds, steps=steps, episodes=episodes, limit=limit)
    make = environment_maker(environment, **_options(options))
    try:
        found = audit_benchmark(make, config, solver=find_policy(solver) if solver else None)  # type: ignore[arg-type]
    except PolicyError as error:
        raise ConfigError(str(error)) from error  # exit code 1 is for faults of the environment
    if as_json:
        print_json(found)
    else:
        for finding in found.findings:
            click.echo(f"fault  {finding.check}: {finding.sentence}")
        for name, reason in found.untested.items():
            click.echo(f"not tested  {name}: {reason}")
        for way, rate in found.rates.items():
            click.echo(f"success, {way}: {rate}")
        faulty = len({finding.check for finding in found.findings})
        click.echo(f"{environment}: {counted(len(found.passed), 'check')} passed, {faulty} found faults")
    raise SystemExit(int(bool(found.findings)))
