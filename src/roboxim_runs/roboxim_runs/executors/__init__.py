"""Executors run jobs that are plain data, on one machine or many, with the same results.

`protocol` defines jobs, workers and executors; `local` runs jobs on processes of this machine, `inline` in
the calling process. A run of any kind (episodes, rendering, a benchmark) hands its jobs to one of them.
"""

from roboxim_runs.executors.inline import InlineExecutor
from roboxim_runs.executors.kept import KeptProcesses
from roboxim_runs.executors.local import LocalExecutor
from roboxim_runs.executors.protocol import (
    Cancellation,
    CancelledError,
    Done,
    Executor,
    Job,
    Lost,
    Note,
    Work,
    Worker,
    WorkerBrokenError,
)
from roboxim_runs.executors.required import run_required

__all__ = [
    "Cancellation",
    "CancelledError",
    "Done",
    "Executor",
    "InlineExecutor",
    "Job",
    "KeptProcesses",
    "LocalExecutor",
    "Lost",
    "Note",
    "Work",
    "Worker",
    "WorkerBrokenError",
    "run_required",
]
