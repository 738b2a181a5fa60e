"""Checks that a call may continue an experiment's folder."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.differences import differences
from roboxim_core.plain_data.documents import read_json
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_eval.experiments import ExperimentConfig, Stage
from roboxim_runs.executors.protocol import as_json
from roboxim_runs.experiments.card import CARD_FILE, DRAWING, STAGES_FILE
from roboxim_runs.experiments.definitions import changed_definitions, changed_policy
from roboxim_runs.experiments.provenance import Origin
from roboxim_runs.experiments.report import STATE_FILE
from roboxim_runs.policies.specs import PolicySpec

DECIDING = ("replicates", "compare", "decide")
"""Keys of an experiment on which verdicts depend, but no stage."""


def state_of(folder: Path) -> dict[str, Any]:
    """Return the content of a folder's ``experiment.json``; empty: it has none."""
    file = folder / STATE_FILE
    stored = read_json(file) if file.exists() else {}
    return stored if isinstance(stored, dict) else {}


def require_renderer(folders: Iterable[Path], stages: Mapping[str, Stage], renderer: str, *, otherwise: str) -> None:
    """Check that finished stages have this call's renderer.

    Args:
        folders: The experiment's folder, and for a shard that of the whole experiment.
        stages: All stages by name.
        renderer: The call's renderer.
        otherwise: Renderer of a folder that states none.

    Raises:
        ConfigError: Naming a stage that has another one.
    """
    for folder in folders:
        usual = state_of(folder).get("renderer") or otherwise  # lines of older versions do not state it
        for entry in ResultsLog(folder / STAGES_FILE).read():
            stage, origin = stages.get(entry.data.get("stage", "")), Origin.of(entry.data)
            found = (origin.renderer if origin else "") or usual
            if stage is not None and stage.kind in DRAWING and found != renderer:
                changed = differences({"renderer": found}, {"renderer": renderer})
                raise ConfigError(
                    f"{folder}: stage '{stage.name}' was finished with other inputs ({changed}); run with "
                    f"--renderer {found}, or choose another output folder (--out)"
                )


def require_definitions(folders: Iterable[Path], stages: Collection[Stage], defined: Mapping[str, str]) -> None:
    """Check that episodes that exist were run with the same tasks, scenes, cameras and models.

    Args:
        folders: See `require_renderer`.
        stages: All stages.
        defined: What `definitions` gives now.

    Raises:
        ConfigError: Naming those that have changed.
    """
    for folder in folders:
        changed = changed_definitions(state_of(folder).get("definitions", {}), defined)
        begun = [stage.name for stage in stages if stage.kind in DRAWING and (folder / stage.name).exists()]
        if begun and changed:
            raise ConfigError(
                f"{folder}: {changed} since stage '{begun[0]}' was begun; put the file back, or choose another "
                "output folder (--out)"
            )


def require_policies(out: Path, policies: Mapping[str, PolicySpec]) -> None:
    """Check that finished evaluations ran with the present files of their policies.

    Args:
        out: The experiment's folder.
        policies: Stage to policy, of finished evaluations whose policy the user names.

    Raises:
        ConfigError: Naming a file that has changed.
    """
    for name, policy in policies.items():
        if changed := changed_policy(policy, out, name):
            raise ConfigError(
                f"{out}: stage '{name}' was finished with an earlier state of its policy: {changed}; "
                "choose another output folder (--out)"
            )


def changed_after_results(out: Path, stored: Mapping[str, Any], config: ExperimentConfig) -> list[str]:
    """Return a sentence if trainings, comparisons or margins differ from those of a card that was written before.

    More trainings until a result is clear find more than they should: chances of error hold for one look.

    Args:
        out: The experiment's folder.
        stored: Its ``experiment.json`` so far.
        config: The experiment now.
    """
    if not stored or not (out / CARD_FILE).exists():
        return []
    before, now = ({key: one.get(key) for key in DECIDING} for one in (stored["config"], as_json(to_plain(config))))
    changed = differences(before, now)
    return [f"changed after results were seen: {changed}; p values are not adjusted for that"] if changed else []
