"""Runs jobs that must all succeed, on workers of this machine unless an executor is given."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from roboxim_core.errors import UnavailableError
from roboxim_runs.executors.inline import InlineExecutor
from roboxim_runs.executors.local import LocalExecutor
from roboxim_runs.executors.protocol import Done, Executor, Job, Work


def run_required(
    work: Work,
    jobs: Sequence[Job],
    *,
    lost: str,
    executor: Executor | None = None,
    workers: int = 1,
    log_dir: Path | None = None,
    **options: Any,
) -> Generator[Done, None, None]:
    """Run jobs, and yield each result as soon as it is available, in any order.

    Args:
        work: The workers' work.
        jobs: The jobs; if there are none, no worker starts.
        lost: Message for a lost job, with ``{}`` for its key, e.g. ``bag {} was not read``.
        executor: Runs the jobs; none: this process, or several processes of this machine.
        workers: Processes of this machine; 1: this process.
        log_dir: Folder of their output; none: a temporary folder.
        **options: For `Executor.run`.

    Raises:
        RoboximError: As `Executor.run` raises it.
        UnavailableError: When a job is lost.
    """
    if not jobs:
        return
    workers = min(workers, len(jobs))
    executor = executor or (LocalExecutor(workers, log_dir=log_dir) if workers > 1 else InlineExecutor())
    outcomes = executor.run(work, jobs, **options)
    try:
        for outcome in outcomes:
            if not isinstance(outcome, Done):
                raise UnavailableError(f"{lost.format(outcome.key)}: {outcome.message}")
            yield outcome
    finally:
        if isinstance(outcomes, Generator):
            outcomes.close()  # ends the other workers now, not when the error is garbage-collected
