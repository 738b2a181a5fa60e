"""The benchmark file: ``config/benchmark/NAME.yaml``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from roboxim_core.config import from_plain
from roboxim_core.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class ReferenceScore:
    """A published score."""

    absolute: float
    """Success rate in held-out cells, 0..1."""
    relative: float | None = None
    """Ratio to the baseline; none: not published."""


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Published results that a report shows next to its own."""

    name: str
    """Measured quantity, and the publication."""
    differences: tuple[str, ...] = ()
    """Differences from a run here, a sentence each."""
    experiments: dict[str, ReferenceScore] = field(default_factory=dict)
    """Experiment to its scores."""
    dimensions: dict[str, ReferenceScore] = field(default_factory=dict)
    """Dimension to its scores."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkConfig:
    """A YAML file of ``config/benchmark``."""

    about: str
    """The question, one sentence."""
    thesis: str = ""
    """Section of the thesis that the shipped experiments follow (see the glossary); empty: none."""
    experiments: tuple[str, ...]
    """Names of files in ``config/experiments``."""
    reference: Reference | None = None
    """Published results; none: not published."""
    scales: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Scale to the keys that it replaces in every experiment; other scales are the experiments' own."""

    def __post_init__(self) -> None:
        """Check that there are experiments.

        Raises:
            ConfigError: When there is none, or one appears twice.
        """
        if not self.experiments or len(set(self.experiments)) != len(self.experiments):
            raise ConfigError(f"experiments must be different names, at least one; got {list(self.experiments)}")


def benchmark_config(data: Any, *, source: str = "benchmark") -> BenchmarkConfig:
    """Build a benchmark from plain data.

    Raises:
        ConfigError: When keys are wrong; names each with its path, its line and the allowed values.
    """
    config: BenchmarkConfig = from_plain(data, BenchmarkConfig, source=source)
    return config


def experiment_changes(config: BenchmarkConfig, scale: str) -> Mapping[str, Any]:
    """Return the key ``scales`` by which a benchmark's scale replaces that of each of its experiments; may be empty."""
    return {"scales": {scale: config.scales[scale]}} if scale in config.scales else {}
