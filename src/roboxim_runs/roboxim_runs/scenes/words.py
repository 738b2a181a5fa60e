"""A task in words: its objects, scene and cameras, and what varies from episode to episode."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

from roboxim_core.config import to_plain
from roboxim_core.errors import counted
from roboxim_runs.episodes.task_choice import named_task
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.lights import LampsConfig
from roboxim_tasks.config import TaskMix, parse_task_config
from roboxim_tasks.task_config import StepConfig, TaskConfig

CELLS = 20
"""Number of cells of a mix that are listed."""


def task_lines(name: str) -> Iterator[str]:
    """Yield the description of a task, line by line.

    Args:
        name: Name in ``config/tasks`` or ``config/suites``, a YAML file, or a skill.

    Raises:
        ConfigError: When there is no such task, or it is not valid.
    """
    text, file = named_task(name)
    config = parse_task_config(text)
    if file is not None:
        comment = itertools.takewhile(lambda line: line.startswith("#"), file.read_text().splitlines())
        yield from (line.lstrip("# ") for line in comment)
        yield f"file          {file}"
    if isinstance(config, TaskMix):
        yield f"mix           {counted(len(config.cells), 'cell')}, {counted(sum(config.counts), 'episode')}"
        for key, count in itertools.islice(zip(config.keys, config.counts, strict=True), CELLS):
            yield f"  {count:>4} of       {key}"
        if len(config.keys) > CELLS:
            yield f"  and {counted(len(config.keys) - CELLS, 'more cell')}"
        firsts: dict[str, tuple[str, TaskConfig]] = {}
        for key, cell in zip(config.keys, config.cells, strict=True):
            firsts.setdefault(cell.skill, (key, cell))
        for key, cell in firsts.values():
            yield ""
            yield f"cell          {key}"
            yield from _lines(cell)
    else:
        yield from _lines(config)


def _lines(config: TaskConfig) -> Iterator[str]:
    yield f"skill         {config.skill}"
    templates = config.templates.values if config.templates else ()
    yield f"instruction   {' | '.join(map(str, templates))}"
    for number, step in enumerate(config.steps, start=1):
        about = ", ".join(role if own == role else f"{own}: {role}" for own, role in step.roles.items())
        words = " | ".join(map(str, step.templates.values if step.templates else ()))
        yield f"step {number:<8} {step.skill} ({about}): {words}"
        yield f"              {_thresholds(step) or 'no thresholds'}"
        if step.arguments:
            yield f"              {_choices(step.arguments)}"
    if config.steps:
        yield f"order         {'any' if config.order == 'any' else 'fixed: a step done before its turn does not count'}"
    for role, thing in config.objects.items():
        yield f"{role:<13} {_choice(thing.models)}{f' ({_choices(thing.modifiers)})' if thing.modifiers else ''}"
    if config.arguments:
        yield f"arguments     {_choices(config.arguments)}"
    others = config.distractors
    if others.maximum:
        yield f"distractors   {others.minimum} to {others.maximum} of {_choice(others.models)}"
    cameras = getattr(config.reset.get("cameras"), "names", ())
    yield f"scene         {config.scene}; cameras {', '.join(cameras) or 'of the scene'}"
    for name, section in config.reset.items():
        if name == "distractors" and not others.maximum:
            continue
        if varied := list(_varied(section)):
            yield f"varies        {name}: {'; '.join(varied)}"
    if not config.steps:
        yield f"thresholds    {_thresholds(config) or 'none'}"
    if config.limits is not None:
        crossed = "crossing one fails" if config.limits.fail else "success does not depend on them"
        limits = ", ".join(
            f"{key} {value:g}" for key, value in to_plain(config.limits).items() if _is_limit(key, value)
        )
        boxes = f"{len(config.limits.keep_out)} keep-out volumes" if config.limits.keep_out else ""
        yield f"limits        {', '.join(filter(None, (limits, boxes))) or 'measured only'}; {crossed}"
    yield f"rate          {config.rate_hz:g} Hz, at most {config.max_steps} steps"


def _thresholds(given: TaskConfig | StepConfig) -> str:
    """Return the thresholds of a skill, and its words that no argument draws."""
    values = {key: value for key, value in to_plain(given.parameters).items() if key not in given.arguments and value}
    return ", ".join(f"{key} {_value(value)}" for key, value in values.items() if type(value) in (float, str))


def _is_limit(key: str, value: Any) -> bool:
    return key not in ("keep_out", "fail") and value > (-1 if key == "distractors" else 0)


def _varied(section: Any, path: str = "") -> Iterator[str]:
    """Yield the values of a component's section that differ from episode to episode."""
    if isinstance(section, LampsConfig) and section.number.ends[-1] == 0:
        return
    for key, value in vars(section).items() if hasattr(section, "__dict__") else ():
        for name, item in value.items() if isinstance(value, dict) else [("", value)]:
            where = ".".join(filter(None, (path, key, name)))
            if isinstance(item, Choice | VectorChoice):
                if item.lower != item.upper or len(item.values) > 1:
                    yield f"{where} {_choice(item)}"
            else:
                yield from _varied(item, where)


def _choices(choices: Mapping[str, Choice]) -> str:
    return "; ".join(f"{name} {_choice(choice)}" for name, choice in choices.items())


def _choice(choice: Choice | VectorChoice) -> str:
    if choice.values:
        return ", ".join(_value(value) for value in choice.values)
    return f"{_value(choice.lower)} to {_value(choice.upper)}"


def _value(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(f'{number:g}' for number in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value) or "none"
