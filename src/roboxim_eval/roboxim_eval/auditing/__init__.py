"""Audit of benchmarks: faults of any Gymnasium environment, found from recorded probes.

`roboxim_runs.environments.benchmark_audit` makes the probes; `audit_findings` judges them without the environment.
"""

from roboxim_eval.auditing.findings import CHECKS, Audit, Finding, audit_findings
from roboxim_eval.auditing.trace import Probes, Trace, digest

__all__ = ["CHECKS", "Audit", "Finding", "Probes", "Trace", "audit_findings", "digest"]
