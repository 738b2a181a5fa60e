"""Writes the report of an experiment's folder: ``card.json``, checked against the results, and ``report.html``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_core.config import from_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import read_json
from roboxim_core.plain_data.shell import shell_line
from roboxim_core.plain_data.yaml_text import parse
from roboxim_core.whole_files import write_json, write_whole
from roboxim_eval.experiments import Design, ExperimentConfig, stages_of
from roboxim_eval.experiments.card import Card, is_card
from roboxim_eval.experiments.card_checks import card_curve, check_card, design_of_card, plain_interval
from roboxim_eval.experiments.cost import FILMS
from roboxim_eval.experiments.spread import card_pairing, pairing_data, spread_data, spread_rows
from roboxim_eval.film_options import FilmOptions
from roboxim_runs.episodes.facts import EpisodeFacts, episode_facts
from roboxim_runs.evaluation.shown import PAGES, place_of, write_episode_page
from roboxim_runs.experiments.card import (
    CARD_FILE,
    Scene,
    collect_card,
    evaluation_folder,
    results_of,
    results_sha256,
    stage_name,
)
from roboxim_runs.experiments.files import checked_design, known_as
from roboxim_runs.experiments.scenes.leakage import scene_leakage
from roboxim_runs.experiments.trained.policies import policy_of
from roboxim_runs.policies.specs import PolicySpec

if TYPE_CHECKING:
    from roboxim_eval.report.charts.table_map import Place
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
    file: str = ""
    """Name or file of the experiment, as the run was given it."""
    policies: Mapping[str, PolicySpec] = field(default_factory=dict)
    """Evaluation stage to the policy that it ran with, as far as the folder states it."""

    @staticmethod
    def of(path: Path) -> ExperimentFolder:
        """Read a folder.

        Raises:
            ConfigError: When it is not an experiment's folder, or its file is damaged.
        """
        state = path / STATE_FILE
        if not state.exists():
            card = path / CARD_FILE
            hint = f"; its card can be read alone: experiment report --from {card}" if card.exists() else ""
            raise ConfigError(f"{path} is not the folder of an experiment: it has no {STATE_FILE}{hint}")
        stored = read_json(state)
        try:
            config: ExperimentConfig = from_plain(stored["config"], ExperimentConfig, source=str(state))
            trainer, name, scale = stored.get("trainer", ""), Path(stored["experiment"]).stem, stored["scale"]
            policies = {
                stage: from_plain(inputs["policy"], PolicySpec, source=str(state))
                for stage, inputs in stored.get("stages", {}).items()
                if "policy" in inputs
            }
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"{state} is damaged: {error!r}") from None
        return ExperimentFolder(
            path=path, name=name, scale=scale, trainer=trainer, renderer=stored.get("renderer", ""),
            design=checked_design(name, config, trainer), benchmark=stored.get("benchmark", ""),
            file=stored["experiment"], policies=policies,
        )  # fmt: skip


def has_only_card(folder: Path) -> bool:
    """Return whether an experiment's folder holds the card of a run elsewhere, and not the run."""
    return (folder / CARD_FILE).exists() and not (folder / STATE_FILE).exists()


def folder_card(folder: ExperimentFolder) -> Card:
    """Return the card of a folder, checked against its results; a folder without a card receives one.

    Raises:
        ConfigError: When evaluations are missing, the card was changed, or results have changed since it was written.
    """
    path = folder.path / CARD_FILE
    stored = read_json(path) if path.exists() else None
    if not is_card(stored):
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
    return check_card(read_json(path), source=str(path))


def write_card(card: Card, out: Path) -> None:
    """Write ``OUT/card.json``."""
    write_json(out / CARD_FILE, card.plain)


def report_data(card: Card, written: Sequence[Path]) -> str:
    """Return what a report says as JSON: sentences, scores, variance components and the files that were written."""
    return json.dumps(
        {
            "experiment": card.experiment.name, "scale": card.experiment.scale, "sha256": card.sha256,
            "sentences": [*card.sentences, *card_warnings(card)], "scores": card.scores,
            "combinations": combinations_data(card),
            "variance_components": spread_data(card), "pairing": pairing_data(card),
            "deviations": list(card.experiment.deviations),
            "written": [str(path) for path in written],
        },
        indent=2,
    )  # fmt: skip


def combinations_data(card: Card) -> list[dict[str, Any]] | None:
    """Return transfer as a curve as plain data, a row for each number of cells; None: it has no combinations."""
    curve = card_curve(card)
    return None if curve is None else [
        {"seen": p.number, "success": plain_interval(p.rate), "trainings": list(p.rates)} for p in curve.points
    ]  # fmt: skip


def curve_lines(card: Card) -> list[str]:
    """Return transfer as a curve in sentences and a line for each number of cells; empty: it has no combinations."""
    curve = card_curve(card)
    if curve is None:
        return []
    rows = [
        f"{point.number:>3} combinations  {100 * point.rate.value:.0f} % ({100 * point.rate.low:.0f} to "
        f"{100 * point.rate.high:.0f}) in held-out cells"
        for point in curve.points
    ]
    return [*curve.sentences, *rows]


def spread_lines(card: Card) -> list[str]:
    """Return what a card's intervals are made of, a line each.

    These are the variance components of its primary comparison and of both its conditions, and what pairing gains.
    """
    primary = card.experiment.config.primary
    names = (primary.first, primary.second, f"{primary.first} - {primary.second}") if primary is not None else ()
    pairing = card_pairing(card)
    rows = [
        f"spread            {row['name']}: SD {row['training']} points between trainings, {row['cell']} between cells, "
        f"{row['both']} cell x training, {row['scene']} rollouts; 95 %: {row['fixed']} over these cells, "
        f"{row['random']} with cells as a sample"
        for row in spread_rows(card)
        if row["name"] in names or primary is None
    ]
    return [*rows, f"pairing           {pairing.sentence}"] if pairing is not None else rows


def write_experiment_report(folder: ExperimentFolder, card: Card, *, films: int = FILMS) -> Path:
    """Write ``report.html`` of an experiment whose evaluations are finished.

    Args:
        folder: The experiment's folder.
        card: Its card.
        films: Films of each condition; those whose bags are gone are left out.

    Returns:
        The page.
    """
    from roboxim_eval.report.experiment import ExperimentPage, experiment_page
    from roboxim_eval.report.films import chosen_films, film_strip
    from roboxim_runs.episodes.pictures import film

    episodes = experiment_episodes(folder)
    shown: dict[int, Any] = {}
    for condition in folder.design.config.conditions:
        there = [
            (str(number), episode.success) for number, episode in enumerate(episodes)
            if episode.arm == condition and episode.bag
        ]  # fmt: skip
        for number in chosen_films(there, films):
            if frames := film(folder.path / episodes[int(number)].bag):
                shown[int(number)] = film_strip(frames)
    episodes = with_pages(folder.path, episodes, sorted(shown))
    page = experiment_page(ExperimentPage(
        card=card, name=known_as(folder.file), episodes=episodes, checkpoints=checkpoint_episodes(folder), films=shown,
        command=reproduction(folder), warnings=scene_leakage(folder.design), place=_place(folder),
    ))  # fmt: skip
    path = folder.path / REPORT_FILE
    write_whole(path, page)
    return path


def with_pages(out: Path, episodes: Sequence[Episode], shown: Sequence[int]) -> list[Episode]:
    """Write the pages that explain the shown episodes, and return all episodes with their addresses.

    A page shows beside its episode those of the other conditions in the same scene, if their films are shown, too.

    Args:
        out: The experiment's folder.
        episodes: The page's episodes.
        shown: Numbers of those whose films are on the page.
    """
    from roboxim_runs.episodes.showing import forget_episodes

    for old in (out / PAGES).glob("*/*.html"):  # of a report that showed other episodes
        old.unlink()
    paged = list(episodes)
    for number in shown:
        episode = episodes[number]
        met = (episodes[other] for other in shown if episodes[other].scene_key == episode.scene_key)
        bag = out / episode.bag
        address = write_episode_page(
            bag, out, run=bag.parent.parent, name=_page_name(episode), film=FilmOptions(), shown_as=bag,
            others={_page_name(one): out / one.bag for one in met if one.arm != episode.arm},
        )  # fmt: skip
        paged[number] = replace(episode, page=address)
    forget_episodes()
    return paged


def _page_name(episode: Episode) -> str:
    """Return the condition of an episode, with its training from the second one on: bags of trainings share names."""
    return f"{episode.arm}.{episode.replicate}" if episode.replicate else episode.arm


def _place(folder: ExperimentFolder) -> Place | None:
    """Return where robot and table are; None: unknown, or not the same in all final evaluations."""
    results = results_of(folder.design, folder.path)
    stages = [stage_name(one.condition, one.replicate) for one in folder.design.evaluations if not one.checkpoint]
    runs = ((evaluation_folder(folder.path, stage), results[stage].values()) for stage in stages)
    return place_of(fact for run, rows in runs for fact in episode_facts(run, rows).values())


def card_warnings(card: Card) -> tuple[str, ...]:
    """Return what weakens a card's results besides its own warnings, by the task files here; none without them."""
    try:
        return scene_leakage(design_of_card(card))
    except ConfigError:
        return ()


def card_page(card: Card) -> str:
    """Return the page of a card without its run's folder: it has no episodes, films, maps and factors."""
    from roboxim_eval.report.experiment import ExperimentPage, experiment_page

    return experiment_page(ExperimentPage(card=card, warnings=card_warnings(card)))


def write_evaluation_pages(folder: ExperimentFolder) -> list[Path]:
    """Write the page of each evaluation of an experiment, with films and recorded factors of its own.

    A run does not write them, since they take seconds each and the experiment's page shows the same episodes.

    Returns:
        The pages.

    Raises:
        ConfigError: When an evaluation is not finished, or its files are damaged.
        RecorderError: With code ``BAG_DAMAGED`` when a bag that a page shows is not whole.
    """
    from roboxim_runs.evaluation.report import report_of

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


def checkpoint_episodes(folder: ExperimentFolder) -> list[Episode]:
    """Return the episodes of an experiment's learning curve, without what their bags say."""
    from roboxim_eval.report.episodes import checkpoint_arm

    results = results_of(folder.design, folder.path)
    found = []
    for one in folder.design.evaluations:
        if one.checkpoint:
            name = stage_name(one.condition, one.replicate, one.checkpoint)
            arm = checkpoint_arm(one.condition, one.checkpoint)
            found += _episodes(folder, name, arm, one.replicate, results[name], facts={})
    return found


def _episodes(
    folder: ExperimentFolder, stage: str, arm: str, replicate: int, rows: Mapping[Scene, EpisodeResult],
    facts: Mapping[str, EpisodeFacts] | None = None,
) -> list[Episode]:  # fmt: skip
    """Return the episodes of an evaluation; what their bags say is read unless it is given."""
    from roboxim_eval.report.episodes import Episode, recorded_factors

    run = evaluation_folder(folder.path, stage)
    facts = episode_facts(run, rows.values()) if facts is None else facts
    order = {cell.key: number for number, cell in enumerate(folder.design.cells)}
    found = []
    for (cell, number), result in sorted(rows.items(), key=lambda item: (order[item[0][0]], item[0][1])):
        known = facts.get(result.episode_id)
        bag = run / result.bag if result.bag else None
        found.append(Episode(
            arm=arm, replicate=replicate, cell=cell, scene=str(number), outcome=result.outcome,
            reason=result.reason, message=result.message, instruction=result.instruction, steps=result.steps,
            bag=bag.relative_to(folder.path).as_posix() if bag is not None and bag.exists() else "",
            start=known.start_from_robot if known else None, explanation=known.explanation if known else "",
            drawn=recorded_factors(known.drawn, known.start_from_robot) if known else {},
        ))  # fmt: skip
    return found


# ------------------------------------------------------------------ how to run it again


def reproduction(folder: ExperimentFolder) -> str:
    """Return the command that runs an experiment again, as far as its folder states it."""
    run, out, prefix = ["experiment", "run", folder.file or folder.name], folder.path, ""
    if folder.benchmark:  # whose scale differs from the experiment's own
        run, out = ["benchmark", folder.benchmark, "--experiment", folder.file or folder.name], folder.path.parent
        prefix = f"{folder.file or folder.name}."
    words = ["roboxim", *run, "--scale", folder.scale, "--out", out.name]
    words += ["--trainer", folder.trainer] if folder.trainer else []
    words += ["--renderer", folder.renderer] if folder.renderer else []
    seed = folder.design.config.evaluate.seed
    words += ["--scene-seed", str(seed)] if seed else []
    return shell_line(*words, *policy_words(folder, prefix))


def policy_words(folder: ExperimentFolder, prefix: str = "") -> list[str]:
    """Return ``--policy`` and ``--option`` of the policies that an experiment's run was given.

    Args:
        folder: The experiment's folder.
        prefix: What precedes their conditions, e.g. the name of the experiment in a benchmark and a dot.
    """
    words = []
    for name, policy in _given(folder).items():
        words += ["--policy", f"{prefix}{name}={policy.spec}"]
        for key, value in policy.options.items():
            words += ["--option", f"{prefix}{name}.{key}={_option_text(value)}"]
    return words


def _option_text(value: Any) -> str:
    """Return a value as ``--option`` reads it: YAML, and a text as it stands unless YAML reads something else."""
    try:
        as_it_stands = isinstance(value, str) and parse(value, source="option") == value
    except ConfigError:
        as_it_stands = False
    return value if as_it_stands else json.dumps(value)


def _given(folder: ExperimentFolder) -> dict[str, PolicySpec]:
    """Return the policies of evaluations that do not follow from the trainings and the other policies."""
    config = folder.design.config
    given: dict[str, PolicySpec] = {}
    final = [stage for stage in stages_of(folder.design) if stage.kind == "evaluate" and "@" not in stage.name]
    for stage in sorted(final, key=lambda stage: bool(config.conditions[_condition(stage.name)].checkpoint_of)):
        stored = folder.policies.get(stage.name)
        if stored is None:
            continue
        try:
            follows = policy_of(folder.design, stage, given, folder.path)
        except ConfigError:  # the expert, which takes no other words: this condition had a policy of its own
            follows = None
        if follows is None or _portable(follows) != _portable(stored):
            given[stage.name.removeprefix("evaluate/")] = PolicySpec(spec=stored.spec, options=stored.options)
    for name in config.conditions:
        matching = {key: policy for key, policy in given.items() if _condition(key) == name}
        one = next(iter(matching.values()), None)
        if (
            one is not None
            and len(matching) == config.replicates.count
            and all(other == one for other in matching.values())
        ):
            given = {key: policy for key, policy in given.items() if key not in matching} | {name: one}
    return given


def _condition(stage: str) -> str:
    return stage.removeprefix("evaluate/").rpartition(".")[0]


def _portable(policy: PolicySpec) -> tuple[str, dict[str, Any]]:
    """Return what a policy is, wherever the folder of the experiment lies: of absolute paths the last two names."""
    here = {
        key: Path(value).parts[-2:] if isinstance(value, str) and Path(value).is_absolute() else value
        for key, value in policy.options.items()
    }
    return policy.spec, here
