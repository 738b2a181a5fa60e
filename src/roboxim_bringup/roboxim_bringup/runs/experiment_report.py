"""Writes the report of an experiment's folder: ``card.json``, checked against the results, and ``report.html``."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_bringup.experiment_card import (
    CARD_FILE,
    Scene,
    collect_card,
    evaluation_folder,
    results_of,
    results_sha256,
    stage_name,
)
from roboxim_bringup.experiment_files import checked_design
from roboxim_bringup.runs.episode_facts import episode_facts
from roboxim_bringup.runs.results_log import write_atomically
from roboxim_core.config import from_plain
from roboxim_core.documents import parse_json, read_text
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import Design, ExperimentConfig
from roboxim_eval.experiments.card import SCHEMA, Card
from roboxim_eval.experiments.card_checks import check_card
from roboxim_eval.experiments.cost import FILMS

if TYPE_CHECKING:
    from roboxim_eval.report.episodes import Episode

STATE_FILE = "experiment.json"
REPORT_FILE = "report.html"


@dataclass(frozen=True, kw_only=True)
class ExperimentFolder:
    """An experiment's folder."""

    path: Path
    """The folder."""
    name: str
    """Name of the experiment."""
    scale: str
    """Its scale."""
    trainer: str
    """Trainer that was chosen; empty: the file's first one."""
    renderer: str
    """Renderer of the images; empty: unknown."""
    design: Design
    """The experiment, expanded."""
    benchmark: str = ""
    """Benchmark that it is a part of; empty: none."""

    @staticmethod
    def of(path: Path) -> ExperimentFolder:
        """Read a folder.

        Raises:
            ConfigError: When it is not an experiment's folder, or its file is damaged.
        """
        state = path / STATE_FILE
        if not state.exists():
            raise ConfigError(f"{path} is not the folder of an experiment: it has no {STATE_FILE}")
        stored = parse_json(read_text(state), source=str(state))
        try:
            config: ExperimentConfig = from_plain(stored["config"], ExperimentConfig, source=str(state))
            trainer, name, scale = stored.get("trainer", ""), Path(stored["experiment"]).stem, stored["scale"]
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"{state} is damaged: {error!r}") from None
        return ExperimentFolder(
            path=path, name=name, scale=scale, trainer=trainer, renderer=stored.get("renderer", ""),
            design=checked_design(name, config, trainer), benchmark=stored.get("benchmark", ""),
        )  # fmt: skip


def folder_card(folder: ExperimentFolder) -> Card:
    """Return the card of a folder, checked against its results; a folder without a card receives one.

    Raises:
        ConfigError: When evaluations are missing, the card was changed, or results have changed since it was written.
    """
    path = folder.path / CARD_FILE
    stored = parse_json(read_text(path), source=str(path)) if path.exists() else None
    if not isinstance(stored, Mapping) or stored.get("schema") != SCHEMA:
        card = collect_card(
            folder.name, folder.scale, folder.design, folder.path, trainer=folder.trainer, renderer=folder.renderer
        )
        write_card(card, folder.path)
        return card
    card = check_card(stored, source=str(path))
    results = results_of(folder.design, folder.path)
    for row in card.evaluations:
        name = stage_name(row.condition, row.replicate, row.checkpoint)
        if name in results and results_sha256(results[name]) != row.results_sha256:
            raise ConfigError(
                f"{folder.path}: the results of {name} have changed since {CARD_FILE} was written; run the experiment "
                "again, which writes a new card"
            )
    return card


def stored_card(path: Path) -> Card:
    """Return the checked card of a file.

    Raises:
        ConfigError: When it is no experiment's card, or was changed.
    """
    return check_card(parse_json(read_text(path), source=str(path)), source=str(path))


def write_card(card: Card, out: Path) -> None:
    """Write ``OUT/card.json``."""
    write_atomically(out / CARD_FILE, json.dumps(card.plain, indent=2) + "\n")


def write_experiment_report(folder: ExperimentFolder, card: Card, *, films: int = FILMS) -> Path:
    """Write ``report.html`` of an experiment whose evaluations are finished.

    Args:
        folder: The experiment's folder.
        card: Its card.
        films: Films of each condition; those whose bags are gone are left out.

    Returns:
        The page.
    """
    from roboxim_bringup.runs.pictures import film
    from roboxim_eval.report.experiment import ExperimentPage, experiment_page
    from roboxim_eval.report.films import chosen_films

    episodes = experiment_episodes(folder)
    shown: dict[int, Any] = {}
    for condition in folder.design.config.conditions:
        there = [
            (str(number), episode.success) for number, episode in enumerate(episodes)
            if episode.arm == condition and episode.bag
        ]  # fmt: skip
        for number in chosen_films(there, films):
            if frames := film(folder.path / episodes[int(number)].bag):
                shown[int(number)] = frames
    page = experiment_page(
        ExperimentPage(card=card, episodes=episodes, films=shown, command=reproduction(folder))
    )  # fmt: skip
    path = folder.path / REPORT_FILE
    write_atomically(path, page)
    return path


def write_evaluation_pages(folder: ExperimentFolder) -> list[Path]:
    """Write the page of each evaluation of an experiment, with films and recorded factors of its own.

    A run does not write them, since they take seconds each and the experiment's page shows the same episodes.

    Returns:
        The pages.

    Raises:
        ConfigError: When an evaluation is not finished, or its files are damaged.
        RecorderError: With code ``BAG_DAMAGED`` when a bag that a page shows is not whole.
    """
    from roboxim_bringup.runs.evaluation_report import report_of

    pages = (
        report_of(folder.path / stage_name(one.condition, one.replicate, one.checkpoint)).report
        for one in folder.design.evaluations
    )
    return [page for page in pages if page is not None]


def experiment_episodes(folder: ExperimentFolder) -> list[Episode]:
    """Return the episodes of an experiment's final evaluations, as a page shows them."""
    results = results_of(folder.design, folder.path)
    found = []
    for evaluation in folder.design.evaluations:
        if not evaluation.checkpoint:
            name = stage_name(evaluation.condition, evaluation.replicate)
            found += _episodes(folder, name, evaluation.condition, evaluation.replicate, results[name])
    return found


def _episodes(
    folder: ExperimentFolder, stage: str, condition: str, replicate: int, rows: Mapping[Scene, EpisodeResult]
) -> list[Episode]:
    from roboxim_eval.report.episodes import Episode, recorded_factors

    run = evaluation_folder(folder.path, stage)
    facts = episode_facts(run, rows.values())
    order = {cell.key: number for number, cell in enumerate(folder.design.cells)}
    found = []
    for (cell, number), result in sorted(rows.items(), key=lambda item: (order[item[0][0]], item[0][1])):
        mine = facts.get(result.episode_id)
        bag = run / result.bag if result.bag else None
        found.append(Episode(
            arm=condition, replicate=replicate, cell=cell, scene=str(number), outcome=result.outcome,
            reason=result.reason, message=result.message, instruction=result.instruction, steps=result.steps,
            bag=bag.relative_to(folder.path).as_posix() if bag is not None and bag.exists() else "",
            start=mine.start if mine else None, drawn=recorded_factors(mine.drawn, mine.start) if mine else {},
        ))  # fmt: skip
    return found


def reproduction(folder: ExperimentFolder) -> str:
    """Return the command that runs an experiment again."""
    run, out = ["experiment", "run", folder.name], folder.path
    if folder.benchmark:  # whose scale differs from the experiment's own
        run, out = ["benchmark", folder.benchmark, "--experiment", folder.name], folder.path.parent
    words = ["roboxim", *run, "--scale", folder.scale, "--out", out.name]
    return shlex.join([*words, *(["--trainer", folder.trainer] if folder.trainer else [])])
