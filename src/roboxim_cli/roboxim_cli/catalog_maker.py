"""Makes the parts of the catalog of `roboxim_cli.catalog`; imports the rooms."""

from __future__ import annotations

import importlib
import inspect
import itertools
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from roboxim_core.config import named_config
from roboxim_core.config_folders import config_names
from roboxim_core.errors import ConfigError

if TYPE_CHECKING:
    from roboxim_eval.experiments import ExperimentConfig

Catalog = dict[str, Any]
"""A part of the catalog, as plain values:

- ``tasks``: ``skills`` (name to instruction and roles), ``tasks`` (name to description), ``broken`` (name of a task to
  the error in its file);
- ``policies``: ``policies`` (name to its first sentence and options);
- ``conventions``: ``conventions`` (name to its line in a list and its whole description), ``broken``;
- ``experiments``: ``experiments`` (name to chapter of the thesis, description and scales, each with its time or an
  empty text), ``benchmarks`` (name to chapter, description, experiments and scales), ``broken``, ``measured`` (whether
  this machine's rates are known)."""
Part = Literal["tasks", "policies", "conventions", "experiments"]


def make_catalog(part: Part) -> Catalog:
    """Make a part of the catalog; see `Catalog`.

    Raises:
        ConfigError: When an object's file is wrong.
    """
    match part:
        case "tasks":
            return make_tasks()
        case "policies":
            return {"policies": _policies()}
        case "conventions":
            return make_conventions()
        case "experiments":
            return make_experiments()


def make_tasks() -> Catalog:
    """Return the skills, the tasks and the errors of invalid task files."""
    from roboxim_core.models.library import ModelLibrary
    from roboxim_tasks.config import TaskMix, load_task_config
    from roboxim_tasks.skills import SKILLS

    library = ModelLibrary()
    models = {name: library.object(name) for name in library.object_ids}
    skills = {name: {"instruction": SKILLS[name].templates[0], "roles": SKILLS[name].suited(models)} for name in SKILLS}
    tasks: dict[str, Any] = {}
    broken: dict[str, str] = {}
    for name in config_names("tasks"):
        try:
            config = load_task_config(name, library)
        except ConfigError as error:
            broken[name] = str(error)
            continue
        if isinstance(config, TaskMix):
            about = {"skills": sorted({cell.skill for cell in config.cells}), "episodes": sum(config.counts)}
        else:
            about = {"skills": [config.skill], "episodes": None}
        tasks[name] = {"about": _first_sentence(named_config("tasks", name).read_text()), **about}
    return {"skills": skills, "tasks": tasks, "broken": broken}


def make_experiments() -> Catalog:
    """Return experiments and benchmarks as plain values; see `Catalog`."""
    from roboxim_eval.experiments import scale_names
    from roboxim_runs.experiments.files import benchmark_experiments, load_benchmark, load_experiment

    made: Catalog = {"experiments": {}, "benchmarks": {}, "broken": {}, "measured": False}
    for name in config_names("experiments"):
        try:
            config = load_experiment(name)
            times = {}
            for scale in scale_names(config):
                times[scale] = _time({name: load_experiment(name, scale)})
                made["measured"] |= bool(times[scale])
        except ConfigError as error:
            made["broken"][name] = str(error)
            continue
        made["experiments"][name] = {"thesis": config.thesis, "about": config.about, "scales": times}
    for name in config_names("benchmark"):
        try:
            benchmark = load_benchmark(name)
            first = load_experiment(benchmark.experiments[0])
            scales = dict.fromkeys((*scale_names(first), *benchmark.scales))
            times = {scale: _time(benchmark_experiments(benchmark, scale)) for scale in scales}
        except ConfigError as error:
            made["broken"][name] = str(error)
            continue
        made["benchmarks"][name] = {
            "thesis": benchmark.thesis, "about": benchmark.about, "experiments": list(benchmark.experiments),
            "scales": times,
        }  # fmt: skip
    return made


def _time(configs: Mapping[str, ExperimentConfig]) -> str:
    """Return the time that experiments take on this machine together, e.g. ``about 3.1 h``; empty: rates are unknown.

    Args:
        configs: Name to experiment, at its scale.
    """
    from roboxim_eval.experiments import cost_of, design_of
    from roboxim_runs.experiments.calibration.rates import stored_rates
    from roboxim_runs.experiments.plan import hours

    total_s, about = 0.0, ""
    for name, config in configs.items():
        rates = stored_rates(config.image_size, name)
        if rates is None:
            return ""
        about = about if rates.experiment == name else "about "
        total_s += cost_of(design_of(config), rates).total_s
    return about + hours(total_s)


def _policies() -> dict[str, Any]:
    importlib.import_module("roboxim_policies.builtin")  # registers the built-in policies
    from roboxim_policies import POLICIES

    return {
        name: {
            "about": (inspect.getdoc(POLICIES[name]) or "").partition("\n")[0],
            "options": {
                option.name: "required" if option.default is option.empty else f"default {option.default!r}"
                for option in inspect.signature(POLICIES[name]).parameters.values()
                if option.kind != option.VAR_KEYWORD
            },
        }
        for name in POLICIES
    }


def make_conventions() -> Catalog:
    """Return the conventions in words, and the errors of invalid files."""
    from roboxim_core.conventions import load_convention
    from roboxim_core.conventions.words import described

    conventions: dict[str, Any] = {}
    broken: dict[str, str] = {}
    for name in config_names("conventions"):
        try:
            convention = load_convention(name)
        except ConfigError as error:
            broken[name] = str(error)
            continue
        conventions[name] = {
            "rate": f"{convention.rate_hz:g} Hz" if convention.rate_hz else "any rate",
            "control": str(convention.action.control), "about": convention.description,
            "described": described(convention),
        }  # fmt: skip
    return {"conventions": conventions, "broken": broken}


def _first_sentence(text: str) -> str:
    """Return the first sentence of a file's leading comment."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    comment = " ".join(line.lstrip("#").strip() for line in lines)
    end = re.search(r"[.!?](?=\s+[A-Z`]|$)", comment)
    return comment[: end.end()] if end else comment
