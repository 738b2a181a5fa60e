"""Whether the audit finds nothing in clean demonstrations of all skills, and how long it takes.

Each skill's task is demonstrated and the bags are audited, with replay. A finding is a fault or a warning; that a
component never changes is none, because in many a single skill the gripper never moves. With ``--out`` episodes are
stored there, and the same command continues an interrupted run.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import click
from benchmarks._harness import Bench

from roboxim_bringup.runs.audit import AuditConfig, audit_dataset
from roboxim_bringup.runs.generation import GenerationConfig, generate
from roboxim_datasets.audit import Finding
from roboxim_tasks.skills import SKILLS

QUICK = ("pick_up", "push_button")


def main() -> None:
    """Measure and print."""
    bench = Bench("audit", __doc__, add_options)
    options = bench.options
    skills, each = (QUICK, 1) if bench.quick else (tuple(SKILLS), -(-options.episodes // len(SKILLS)))
    with tempfile.TemporaryDirectory() as scratch:
        out = (options.out or Path(scratch)).absolute()
        clean = total = 0
        for skill in skills:
            row, findings = measure(skill, each, out, options.seed)
            bench.row(**row)
            total += int(row["episodes"])
            clean += int(row["episodes"]) - len({name for finding in findings for name in finding.episodes})
            for finding in findings:
                click.echo(f"{skill} {', '.join(finding.episodes)}: {finding.text}")
    bench.finish(f"share of {total} clean episodes without a finding", clean / total, "", at_least=1.0)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="store episodes here and continue from them")
    parser.add_argument("--episodes", type=int, default=500, metavar="N", help="episodes of all skills (default: 500)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the demonstrations (default: 0)")


def measure(skill: str, episodes: int, out: Path, seed: int) -> tuple[dict[str, str | float], list[Finding]]:
    """Demonstrate and audit a skill; return the row and the findings."""
    generate(GenerationConfig(task=skill, out=out / skill, episodes=episodes, seed=seed, first_try=True))
    start = time.perf_counter()
    result = audit_dataset(out / skill, out / f"{skill}-audit", AuditConfig(replay=True)).result
    seconds = time.perf_counter() - start
    findings = [finding for _, finding in result.findings() if finding.episodes]
    return {
        "skill": skill,
        "episodes": result.episodes,
        "findings": len(findings),
        "ms_per_episode": round(1e3 * seconds / max(result.episodes, 1)),
    }, findings


if __name__ == "__main__":
    main()
