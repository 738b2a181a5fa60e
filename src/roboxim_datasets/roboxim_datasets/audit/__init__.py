"""Audit of datasets: finds faults that spoil training data, by an extensible set of checks.

The checks here are pure. Ground truth (`Truth`) comes from whoever has it; in RoboXim `roboxim_runs.datasets.audit`
measures it from bags, with the judge and a renderer.
"""

from roboxim_datasets.audit.audit import Auditor
from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import (
    Approach,
    AuditEpisode,
    AuditResult,
    CannotCheckError,
    CheckResult,
    ColorPair,
    Finding,
    Meaning,
    Severity,
    Sighting,
    Touch,
    Truth,
)

__all__ = [
    "AUDIT_CHECKS",
    "Approach",
    "AuditCheck",
    "AuditEpisode",
    "AuditResult",
    "Auditor",
    "CannotCheckError",
    "CheckResult",
    "ColorPair",
    "Finding",
    "Meaning",
    "Severity",
    "Sighting",
    "Touch",
    "Truth",
]
