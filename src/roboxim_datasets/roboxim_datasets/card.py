"""The card of a dataset: its ``README.md``, whose head a hub of datasets reads, and a summary in a few lines."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from roboxim_core.config import to_plain
from roboxim_core.errors import counted
from roboxim_core.whole_files import write_whole
from roboxim_datasets.account import Account, lines, to_json
from roboxim_datasets.dataset import EXPORT_FILE, Dataset, in_order
from roboxim_datasets.files import reading
from roboxim_datasets.statistics import dead_components
from roboxim_datasets.view import contact_sheet, encoded

CARD_FILE = "README.md"
PICTURE_FILE = "preview.jpg"
LISTED = 20
"""Further instructions are only counted."""
STATISTICS = ("mean", "std", "min", "q01", "q99", "max")


@dataclass(frozen=True, kw_only=True)
class Counts:
    """Number of steps and episodes of a dataset, by split, instruction and skill."""

    steps: Mapping[str, int]
    """Split to number of steps."""
    instructions: Mapping[str, int]
    """Instruction to number of episodes that have it in a step, most frequent first."""
    skills: Mapping[str, int] = field(default_factory=dict)
    """Skill to number of episodes, as far as the episodes state it."""
    successes: int
    """Number of episodes that solved their task at the end."""
    outcomes: int
    """Number of episodes of which the dataset says whether they did."""
    shortest: int
    """Length of the shortest episode [steps]."""
    longest: int
    """Length of the longest one [steps]."""


def count(dataset: Dataset) -> Counts:
    """Count a dataset's steps and episodes; this reads the description of every episode.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it cannot be read.
    """
    steps: Counter[str] = Counter()
    instructions: Counter[str] = Counter()
    skills: Counter[str] = Counter()
    lengths, outcomes = [], []
    for split, episodes in dataset.splits.items():
        for index in range(episodes):
            with reading(f"{dataset.path}, {split}[{index}]"):
                episode = dataset.read(split, index)
            steps[split] += episode.length
            instructions.update(episode.instructions or [episode.instruction])
            skills.update([str(episode.metadata["skill"])] if "skill" in episode.metadata else [])
            outcomes += [] if episode.success is None else [episode.success]
            lengths.append(episode.length)
    return Counts(
        steps=dict(steps), instructions=dict(instructions.most_common()), skills=dict(skills.most_common()),
        successes=sum(outcomes), outcomes=len(outcomes),
        shortest=min(lengths, default=0), longest=max(lengths, default=0),
    )  # fmt: skip


def summary(dataset: Dataset, counts: Counts) -> str:
    """Return a few lines that describe a dataset.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it cannot be read.
    """
    with reading(dataset.path):
        rows = [f"{name:<10}{value}" for name, value in _rows(dataset, counts).items()]
        return "\n".join([*rows, *account_lines(dataset.account)])


def account_lines(account: Account) -> list[str]:
    """Return what a reader left out or changed, a line for each kind of thing."""
    return [*lines("note", account.changed), *lines("left out", account.left_out)]


def summary_json(dataset: Dataset, counts: Counts) -> dict[str, Any]:
    """Return a dataset's description as plain data, with the account of its files' parts."""
    account = dataset.account
    return {
        "format": dataset.format,
        "version": dataset.version,
        "splits": dict(dataset.splits),
        "episodes": len(dataset),
        "steps": dict(counts.steps),
        "solved": counts.successes,
        "outcomes_stated": counts.outcomes,
        "rate_hz": dataset.description.fps,
        "instructions": dict(counts.instructions),
        "cameras": {name: [size.height, size.width] for name, size in dataset.features.cameras.items()},
        "vectors": {name: len(parts) for name, parts in dataset.features.vectors.items()},
        "signals": {name: len(parts) for name, parts in dataset.features.signals.items()},
        "action": list(dataset.features.action),
        "read": to_json([part for part in account.parts if part.treatment == "read"]),
        "implied": to_json([part for part in account.parts if part.treatment == "implied"]),
        "left_out": to_json(account.left_out),
    }


def _solved(counts: Counts, episodes: int) -> str:
    """Return how many episodes solved their tasks, as far as the dataset states it."""
    if not counts.outcomes:
        return "solved: unknown"
    unknown = episodes - counts.outcomes
    return f"{counts.successes} of {counts.outcomes} solved" + (f", {unknown} unknown" if unknown else "")


def _rows(dataset: Dataset, counts: Counts) -> dict[str, str]:
    about, features = dataset.description, dataset.features
    cameras = ", ".join(f"{name} {size.width}x{size.height}" for name, size in features.cameras.items())
    kind = "lossless" if features.lossless else "encoded with loss"
    semantics = about.semantics
    meaning = _unstated(dataset)
    if semantics:
        meaning = f"{semantics.control}, {semantics.rotation}, gripper {semantics.gripper}"
    return {
        "format": f"{dataset.format} {dataset.version}".rstrip(),
        "folder": str(dataset.path),
        "episodes": ", ".join(f"{count} {split}" for split, count in dataset.splits.items())
        + f"; {_solved(counts, len(dataset))}",
        "steps": f"{sum(counts.steps.values())}, {counts.shortest} to {counts.longest} an episode, "
        + (f"{about.fps:g} Hz" if about.fps else "rate not stated"),
        "robot": about.robot or "not stated",
        "cameras": f"{cameras or 'none'} ({kind})",
        "actions": f"{len(features.action)}: {', '.join(features.action)} ({meaning})",
        "observed": "; ".join(f"{name} ({len(parts)})" for name, parts in features.vectors.items()) or "nothing",
        "signals": ", ".join(features.signals) or "none",
        "skills": _listed(counts.skills) or "not stated",
        "tasks": f"{len(counts.instructions)}: " + _listed(counts.instructions, 5),
        "dead": ", ".join(dead_action_components(dataset)) or "none",
        "made by": _maker(dataset),
    }


def dead_action_components(dataset: Dataset) -> tuple[str, ...]:
    """Return the action's components that (nearly) never change, as far as the dataset has statistics."""
    deviations = dataset.summaries().get("action", {}).get("std", ())
    return dead_components(dataset.features.action, deviations)


def _unstated(dataset: Dataset) -> str:
    named = (dataset.folder / "convention.yaml").is_file()
    return "in the units of convention.yaml" if named else "meaning not stated"


def _maker(dataset: Dataset) -> str:
    facts = dataset.facts
    if not facts:
        return "not stated"
    if "how" in facts:
        sources = ", ".join(f"{s.get('name')} ({s.get('format')})" for s in facts.get("sources", []))
        return f"roboxim dataset {facts['how']}, from {sources}"
    return f"roboxim export {facts.get('format', '')}, from {', '.join(facts.get('runs', [])) or 'bags'}"


def _simulated(facts: Mapping[str, Any]) -> bool:
    """Return whether a dataset was made from RoboXim's bags, as far as it says."""
    return "runs" in facts or any(_simulated(source) for source in facts.get("sources", []))


def _listed(counts: Mapping[str, int], max_items: int = LISTED) -> str:
    shown = [f"{name} x{number}" for name, number in list(counts.items())[:max_items]]
    return ", ".join(shown) + (", ..." if len(counts) > max_items else "")


def card(dataset: Dataset, counts: Counts) -> str:
    """Return the text of ``README.md``.

    Args:
        dataset: The dataset.
        counts: Its counts.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when the dataset cannot be read.
    """
    with reading(dataset.path):
        return _card(dataset, counts)


def _card(dataset: Dataset, counts: Counts) -> str:
    parts = [
        _head(dataset),
        f"# {_title(dataset, counts)}\n\n{dataset.description.text or _sentence(dataset)}\n",
        f"![Frames of the first episode, one row for each camera]({_picture(dataset)})\n"
        * bool(dataset.features.cameras),
        _table(("", ""), [(name, value) for name, value in _rows(dataset, counts).items() if name in _SHOWN]),
        f"## Loading\n\n{dataset.usage}" if dataset.usage else "",
        _actions(dataset),
        _vectors(dataset),
        _statistics(dataset),
        _counts_section(dataset, counts),
        _not_read(dataset),
        _how(dataset),
        _LICENCE + (_RENDERED if _simulated(dataset.facts) else ""),
    ]
    return "\n".join(part.rstrip() + "\n" for part in parts if part)


_SHOWN = ("format", "episodes", "steps", "robot", "cameras", "skills", "made by")
"""Lines of the summary that the card's first table has; its sections say the others at length."""


def _head(dataset: Dataset) -> str:
    size = next(name for limit, name in _SIZES if len(dataset) < limit)
    origin = ["simulation", "roboxim"] if _simulated(dataset.facts) else []
    tags = ["robotics", *origin, dataset.format, *filter(None, [dataset.description.robot])]
    lines = [
        "---",
        "license: other",
        "license_name: chosen-by-the-publisher",
        "task_categories:",
        "- robotics",
        "tags:",
    ]
    if dataset.format == "lerobot":
        tags[1:1] = ["LeRobot"]  # as its hub finds it
    lines += [f"- {tag}" for tag in tags] + ["language:", "- en", "size_categories:", f"- {size}", "---", ""]
    return "\n".join(lines)


_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (10**12, "100K<n<1M"))


def _title(dataset: Dataset, counts: Counts) -> str:
    skills = list(counts.skills)
    return f"{dataset.description.robot or 'Robot'} demonstrations" + (f": {', '.join(skills)}" if skills else "")


def _sentence(dataset: Dataset) -> str:
    return f"{counted(len(dataset), 'episode')} in the format {dataset.format} {dataset.version}.".replace(" .", ".")


def _actions(dataset: Dataset) -> str:
    about = dataset.description
    text = "## Actions\n\nA step is an observation and the action that leads to the next one. Components: "
    text += f"{_names(about.features.action)}.\n"
    if about.semantics:
        semantics = json.dumps(to_plain(about.semantics), indent=2)
        text += f"\nTheir meaning (`roboxim_core.actions.ActionSemantics`):\n\n```json\n{semantics}\n```\n"
        text += (
            f"\nThe gripper is absolute: {about.semantics.gripper.open_value:g} is open, "
            f"{about.semantics.gripper.closed_value:g} closed. Do not normalise it.\n"
        )
    if (dataset.folder / "convention.yaml").is_file():
        text += (
            "\n`convention.yaml` says what a policy that was trained on this dataset is sent and what its answers "
            "mean: `roboxim evaluate --option convention=convention.yaml`.\n"
        )
    if "sim.action_executed" in about.features.signals:
        text += (
            "\n`sim.action_executed` is the executed action, of the same meaning: it holds the noise that was injected "
            "into the demonstration and that the action corrects. Trainers ignore it.\n"
        )
    return text


def _vectors(dataset: Dataset) -> str:
    rows = [(f"`{name}`", str(len(parts)), _names(parts)) for name, parts in dataset.features.vectors.items()]
    own = (
        "Positions are in metres, joint positions in radians, openings from 0 (closed) to 1 (open). `tcp` is the tool "
        "centre point in the robot's base; `x_axis` and `y_axis` are the first two columns of its rotation matrix.\n"
    )
    stated = {
        "meaning not stated": "The dataset does not state their units.\n",
        "in the units of convention.yaml": "`convention.yaml` says their units and ranges.\n",
    }
    units = own if dataset.description.semantics else stated[_unstated(dataset)]
    return "## Observations\n\n" + _table(("vector", "size", "components"), rows) + ("\n" + units if rows else "")


def _names(parts: Sequence[str]) -> str:
    return ", ".join(f"`{part}`" for part in parts)


def _statistics(dataset: Dataset) -> str:
    found, names = dataset.summaries(), {"action": dataset.features.action, **dataset.features.vectors}
    text = ""
    for vector in ("action", "state"):
        values = found.get(vector)
        if not values or vector not in names:
            continue
        columns = [name for name in STATISTICS if name in values]
        dead = dead_action_components(dataset) if vector == "action" else ()
        rows = [
            (f"`{part}`" + (" (dead)" if part in dead else ""), *(f"{values[name][i]:.5g}" for name in columns))
            for i, part in enumerate(names[vector])
        ]
        text += f"\n{vector}:\n\n" + _table(("component", *columns), rows)
    of = f"the split `{in_order(dataset.splits)[0]}`" if dataset.format == "rlds" else "all episodes"
    return f"## Statistics\n\nOf {of}, as they are stored beside the data.\n{text}" if text else ""


def _counts_section(dataset: Dataset, counts: Counts) -> str:
    rows = [(f"`{split}`", str(number), str(counts.steps.get(split, 0))) for split, number in dataset.splits.items()]
    text = "## Counts\n\n" + _table(("split", "episodes", "steps"), rows)
    cells = {split: found for split, found in dataset.facts.get("cells", {}).items() if len(found) > 1}
    for split, found in cells.items():
        text += f"\nCells of `{split}`:\n\n" + _table(("cell", "episodes"), [(c, str(n)) for c, n in found.items()])
    shown = [(text_, str(number)) for text_, number in list(counts.instructions.items())[:LISTED]]
    text += "\n" + _table(("instruction", "episodes"), shown)
    if len(counts.instructions) > LISTED:
        text += f"\nand {len(counts.instructions) - LISTED} more instructions.\n"
    return text


def _not_read(dataset: Dataset) -> str:
    """Return the parts of a converted dataset's sources that it lacks."""
    missing = dataset.facts.get("not_read", [])
    rows = [
        (f"{item.get('kind')} `{item.get('name')}`", str(item.get("count")), str(item.get("why"))) for item in missing
    ]
    return "## Left out of the sources\n\n" + _table(("part", "number", "why"), rows) if rows else ""


def _how(dataset: Dataset) -> str:
    facts = {key: value for key, value in dataset.facts.items() if key not in ("cells", "not_read")}
    if not facts:
        return ""
    facts_text = json.dumps(facts, indent=2, sort_keys=True)
    return f"## How it was made\n\nBy RoboXim: {_maker(dataset)}. `{EXPORT_FILE}`:\n\n```json\n{facts_text}\n```\n"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


_LICENCE = """## Licence

Who publishes the dataset chooses its licence: edit the head of this file.
"""
_RENDERED = """The images are renderings of the robot and object models of RoboXim; the robots' meshes come with
licences of their own.
"""


def write_card(dataset: Dataset) -> Path:
    """Write ``README.md`` and its picture into a dataset's folder; a crash leaves the old files or none.

    Beside a dataset that is a single file, the card has the file's name with the suffix ``.md``.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when the dataset cannot be read.
        OSError: When the files cannot be written.
    """
    place = card_path(dataset.path)
    files = {place: card(dataset, count(dataset)).encode()}
    if dataset.features.cameras:
        picture = _picture(dataset)
        files = {dataset.folder / picture: encoded(contact_sheet(dataset.episode(0)), "JPEG"), **files}
    for file, content in files.items():
        write_whole(file, content)
    return place


def card_path(path: Path) -> Path:
    """Return where the card of a dataset lies."""
    return path.with_suffix(".md") if path.is_file() else path / CARD_FILE


def _picture(dataset: Dataset) -> str:
    return f"{dataset.path.stem}.jpg" if dataset.path.is_file() else PICTURE_FILE
