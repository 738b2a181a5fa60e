"""Faults to plant in copies of datasets: for tests of the audit, and for experiments on what a fault costs.

Each edits one episode's values. Faults that need the simulator are in `roboxim_runs.datasets.corruption`.
"""

from roboxim_datasets.audit.faults import edits
from roboxim_datasets.audit.faults.values import DATASET_FAULTS, DatasetFault, EditableEpisode, choose

__all__ = ["DATASET_FAULTS", "DatasetFault", "EditableEpisode", "choose", "edits"]
