"""Chooses and edits episodes of a dataset by conditions and edits; the source is only read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial

from roboxim_core.config import from_json
from roboxim_core.errors import ConfigError, ErrorCode, RecorderError
from roboxim_core.specs import TaskSpec
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode, Step, Wanted, with_words
from roboxim_datasets.plans import Place, plan_of
from roboxim_datasets.where import Choice, Edit, Fact, facts_of_task


def chosen_plan(dataset: Dataset, texts: Iterable[str]) -> dict[str, list[Place]]:
    """Return the plan that keeps the episodes that meet conditions, each in its split, with its edits.

    Args:
        dataset: The dataset.
        texts: Conditions and edits, see `roboxim_datasets.where`. An episode is named by its id or by its split and
            number, e.g. ``train/3``.

    Raises:
        InvalidRequestError: On a condition or an edit that refers to no episode, or to more steps than the episode has.
        RecorderError: ``EXPORT_REFUSED`` when no episode is left; ``BAG_DAMAGED`` when one cannot be read.
    """
    choice = Choice.parse(texts)
    places = plan_of(dataset)
    known = {split: [facts_of(place) for place in group] for split, group in places.items()}
    choice.require_known([facts for group in known.values() for facts in group])
    found: dict[str, list[Place]] = {}
    for split, group in places.items():
        for place, facts in zip(group, known[split], strict=True):
            if choice.refusal(facts):
                continue
            edit = choice.edit_of(facts["episode"])
            if edit is not None:
                edit.require_within(int(facts["steps"][0]))
                edit = replace(edit, episode=facts["episode"][0])
                place = replace(place, change=partial(edited, edit=edit), changed=edit)
            found.setdefault(split, []).append(place)
    if not found:
        raise RecorderError(f"no episode of {dataset.path} meets the conditions; change them", ErrorCode.EXPORT_REFUSED)
    return found


def facts_of(place: Place) -> dict[str, Fact]:
    """Return what conditions can compare of an episode: what the dataset says of it, and its recorded task."""
    episode = place.read()
    outcome = {True: "success", False: "failure", None: "unknown"}[episode.success]
    metadata = {name: (str(value),) for name, value in episode.metadata.items() if name != "task"}
    name = f"{place.split}/{place.index}"
    facts = metadata | {
        "episode": (episode.episode_id, name) if episode.episode_id else (name,),
        "split": (place.split,),
        "instruction": (episode.instruction,),
        "outcome": (outcome,),
        "steps": (str(episode.length),),
        "robot": (episode.robot,),
        "camera": tuple(episode.cameras),
        "rate_hz": (f"{episode.fps:g}",) if episode.fps else (),
    }
    try:
        task = from_json(str(episode.metadata.get("task", "")), TaskSpec)
    except ConfigError:  # none was recorded, or another tool uses the name
        return facts
    return facts_of_task(task) | facts


def edited(episode: Episode, edit: Edit) -> Episode:
    """Return an episode with an edit applied; whether one is solved whose end is cut off is unknown.

    Raises:
        InvalidRequestError: When it has fewer steps than it keeps.
    """
    first, last = edit.require_within(episode.length)
    words, read = edit.instruction, episode.read

    def steps(wanted: Wanted) -> Iterator[Step]:
        for step in read(wanted):
            if step.index > last:
                return
            if step.index >= first:
                yield replace(
                    step, index=step.index - first, instruction=words or episode.words(step),
                    subtask=None if words else step.subtask,
                )  # fmt: skip

    cut = last < episode.length - 1
    made = replace(episode, read=steps, length=last - first + 1, success=None if cut else episode.success)
    if words:
        return replace(made, instruction=words, instructions=(), subtasks=())
    if not (episode.instructions or episode.subtasks):
        return made
    return with_words(made, [(episode.words(step), step.subtask) for step in steps(Wanted())])
