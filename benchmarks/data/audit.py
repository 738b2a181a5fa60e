"""Whether the audit finds nothing in clean demonstrations of all skills, and how long it takes.

Each skill's task is demonstrated and the bags are audited, with replay. A finding is a fault or a warning; that a
component never changes is none, because in many a single skill the gripper never moves. With ``--out`` episodes and
finished audits are stored there, and the same command continues an interrupted run.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import click
from benchmarks._harness import Bench
from benchmarks.data._demonstrations import QUICK, demonstrations

from roboxim_core.whole_files import write_whole
from roboxim_recorder.run_bags import list_bags
from roboxim_runs.datasets.audit import AuditConfig, audit_dataset


def main() -> None:
    """Measure and print."""
    bench = Bench("audit", __doc__, add_options)
    options = bench.options
    episodes, skills = (len(QUICK), QUICK) if bench.quick else (options.episodes, ())
    with tempfile.TemporaryDirectory() as scratch:
        out = (options.out or Path(scratch)).absolute()
        clean = total = 0
        for skill, run in demonstrations(
            out, episodes, skills=skills, seed=options.seed, workers=options.workers
        ).items():
            row, findings = measure(skill, run)
            bench.row(**row)
            total += int(row["episodes"])
            clean += int(row["episodes"]) - len({name for names in findings.values() for name in names})
            for text, names in findings.items():
                click.echo(f"{skill} {', '.join(names)}: {text}")
    bench.finish(f"share of {total} clean episodes without a finding", clean / total, "", at_least=1.0)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, metavar="DIR", help="store episodes here and continue from them")
    parser.add_argument("--episodes", type=int, default=500, metavar="N", help="episodes of all skills (default: 500)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the demonstrations (default: 0)")
    parser.add_argument("--workers", type=int, default=2, help="processes that demonstrate (default: 2)")


def measure(skill: str, run: Path) -> tuple[dict[str, str | float], dict[str, list[str]]]:
    """Audit a skill's run; return the row and the findings, text to episodes. A finished audit is not repeated."""
    stored, bags = run.with_name(f"{skill}-audited.json"), len(list_bags(run))
    if stored.is_file() and (known := json.loads(stored.read_text()))["row"]["episodes"] == bags:
        return known["row"], known["findings"]
    start = time.perf_counter()
    result = audit_dataset(run, run.with_name(f"{skill}-audit"), AuditConfig(replay=True)).result
    seconds = time.perf_counter() - start
    findings = {finding.text: list(finding.episodes) for _, finding in result.findings() if finding.episodes}
    row: dict[str, str | float] = {
        "skill": skill,
        "episodes": result.episodes,
        "findings": len(findings),
        "unreadable": len(result.unreadable),
        "ms_per_episode": round(1e3 * seconds / max(result.episodes, 1)),
    }
    write_whole(stored, json.dumps({"row": row, "findings": findings}, indent=2) + "\n")
    return row, findings


if __name__ == "__main__":
    main()
