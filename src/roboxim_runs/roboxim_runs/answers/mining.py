"""Searches the continuous factors of a task for regions where a policy fails."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from roboxim_core.config import digest, parse_yaml, to_plain
from roboxim_core.episode import ActorPort, RunConfig, episode_id
from roboxim_core.errors import ConfigError, ErrorCode, RoboximError, one_of
from roboxim_core.plain_data.differences import differences
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_core.plain_data.yaml_text import plain
from roboxim_core.poses import Array
from roboxim_core.seeds import SeedPath
from roboxim_eval.answers.regions import Factor, Region, SearchConfig, search
from roboxim_recorder.bag_writer import find_episode
from roboxim_runs.answers.trying import TryBench
from roboxim_runs.episodes.task_choice import cells_of
from roboxim_runs.scenes.definitions import definitions_of, task_files
from roboxim_runs.storage.occupied import require_own

if TYPE_CHECKING:
    from roboxim_tasks.task_config import TaskConfig

Place = tuple[str | int, ...]
WORDS = {
    "reset.objects.area": "the object",
    "reset.objects.yaw_rad": "yaw of the object",
    "reset.lights.intensity": "light intensity",
    "reset.physics.table_friction": "friction of the table",
    "reset.robot.position": "the gripper at the start",
    "reset.robot.yaw_rad": "yaw of the gripper at the start",
}
EDGES = {
    "reset.objects.area.0": ("near edge of its area", "far edge of its area"),
    "reset.objects.area.1": ("right edge of its area", "left edge of its area"),
}
"""What lies at the ends of a range, seen from the robot."""
PLACES = ("area", "position")
"""Last keys of ranges that are places in the world [m]."""
UNITS = {"_rad": "rad", "_m": "m"}
"""Ends of keys to the unit of what they say."""
AREA = ("reset", "objects", "area")
"""The range in which a task's objects lie: at a point, it is that of one of them, for two cannot lie at one place."""
OTHERS_AREA = ("reset", "distractors", "area")
"""The range in which distractors lie: no factor where there are several, or some lie near the target."""
ROLLOUTS = "rollouts.jsonl"
"""File of a search's folder with the outcome of each point."""
SUCCESS, FAILURE, UNSOLVED, INFEASIBLE = "success", "failure", "unsolved", "infeasible"
"""What becomes of a point; the last two are neither: the expert failed too, or there is no scene."""
WIDTH = 1e-6
"""Part of its range that a factor keeps at a point: a range must not be empty."""


@dataclass(frozen=True, kw_only=True)
class MineConfig:
    """What is searched."""

    task_config: str
    """Task configuration, YAML; its ranges are the factors."""
    factors: tuple[str, ...] = ()
    """Names of the factors to vary, or what they begin with; empty: all. The others are drawn as the task says."""
    search: SearchConfig = SearchConfig()
    """Size of the search."""
    run: RunConfig = RunConfig()
    """How the policy acts."""
    policy: Mapping[str, Any] = field(default_factory=dict)
    """What defines the policy, from `ChosenPolicy.identity`; a search in a folder continues with the same alone."""


@dataclass(frozen=True, kw_only=True)
class Mined:
    """What was found."""

    regions: list[Region]
    """The boxes, the clearest first."""
    factors: tuple[Factor, ...]
    """The factors."""
    rollouts: int
    """Rollouts of the policy."""
    failures: int
    """Those that failed in a scene that the expert solves. A policy that fails everywhere has no region."""
    unsolved: int
    """Scenes that the policy failed and the expert did not solve either; they are no failures."""
    infeasible: int
    """Points for which no scene exists."""
    bags: dict[str, list[str]]
    """Region in words to bags of failed scenes in it."""


def factors_of(task_config: str, names: Sequence[str] = ()) -> dict[str, tuple[Factor, Place, int | None]]:
    """Return the factors of a task: name to the factor, the place of its range, and the component of a vector.

    The area of several objects is a factor of the one of `role_at_point`; the area of several distractors is none.

    Args:
        task_config: Task configuration, YAML.
        names: Names, or what they begin with; empty: all.

    Raises:
        ConfigError: When a name is of no factor, or there is none.
    """
    found: dict[str, tuple[Factor, Place, int | None]] = {}
    crowded, role = any(map(_crowded, cells_of(task_config))), role_at_point(task_config)
    for path, low, high in _ranges(parse_yaml(task_config), ()):
        name = ".".join(map(str, path))
        if path == OTHERS_AREA and crowded:
            continue
        if isinstance(low, list):
            for place, (a, b) in enumerate(zip(low, high, strict=True)):
                if a < b:
                    full = f"{name}.{place}"
                    found[full] = (_factor(full, name, a, b), path, place)
        elif low < high:
            found[name] = (_factor(name, name, low, high), path, None)
    unknown = [one for one in names if not any(name.startswith(one) for name in found)]
    if unknown:
        raise ConfigError(f"no factor '{unknown[0]}' in the task; {one_of(found, unknown[0])}")
    chosen = {key: value for key, value in found.items() if not names or key.startswith(tuple(names))}
    if not chosen:
        raise ConfigError("the task has no range {lower: ..., upper: ...} to search")
    if role:
        chosen = {
            name: (replace(factor, words=f"the {role}") if path == AREA else factor, path, place)
            for name, (factor, path, place) in chosen.items()
        }
    return chosen


def _factor(name: str, key: str, low: float, high: float) -> Factor:
    parts = key.split(".")
    place = parts[-1] in PLACES
    unit = "m" if place else next((unit for part in parts for end, unit in UNITS.items() if part.endswith(end)), "")
    return Factor(
        name=name, lower=float(low), upper=float(high), words=WORDS.get(key, ""), edges=EDGES.get(name, ("", "")),
        unit=unit, axis="xyz"[int(name.rpartition(".")[2])] if place and name != key else "",
    )  # fmt: skip


def _ranges(value: Any, path: Place) -> Iterator[tuple[Place, Any, Any]]:
    if isinstance(value, dict):
        low, high = value.get("lower"), value.get("upper")
        if _numbers(low) and _numbers(high):
            yield path, low, high
            return
        for key, inner in value.items():
            yield from _ranges(inner, (*path, key))


def _numbers(value: Any) -> bool:
    rows = value if isinstance(value, list) else [value]
    return bool(rows) and all(isinstance(one, int | float) and not isinstance(one, bool) for one in rows)


def _crowded(task: TaskConfig) -> bool:
    near = getattr(task.reset.get(OTHERS_AREA[1]), "near", None)
    return task.distractors.maximum > 1 or task.distractors.maximum > 0 and near is not None


def role_at_point(task_config: str) -> str:
    """Return the role whose object alone lies at a point's place, since the task's area is of several; else empty."""
    (task, *others) = cells_of(task_config)
    area, apart = task.reset.get("interaction_area"), getattr(task.reset.get(AREA[1]), "roles", {})
    placed = [role for role in task.objects if role not in apart and (area is None or role not in area.roles)]
    if others or len(placed) < 2:
        return ""
    return "target" if "target" in placed else placed[0]


def at_point(
    data: Any, factors: dict[str, tuple[Factor, Place, int | None]], point: Sequence[float], role: str = ""
) -> Any:
    """Return a task configuration whose factors have the values of a point, each in a range of almost no width.

    Args:
        data: The task.
        factors: The factors.
        point: Their values.
        role: Role whose object lies at the point's place, see `role_at_point`; the others lie where the task says.
    """
    data = copy.deepcopy(data)
    objects = (data.get(AREA[0]) or {}).get(AREA[1]) or {}
    whole = copy.deepcopy(objects.get(AREA[2])) if role else None
    for (factor, path, place), value in zip(factors.values(), point, strict=True):
        inner = data
        for key in path:
            inner = inner[key]
        half = WIDTH * (factor.upper - factor.lower)
        low, high = max(factor.lower, value - half), min(factor.upper, value + half)
        if place is None:
            inner["lower"], inner["upper"] = float(low), float(high)
        else:
            inner["lower"], inner["upper"] = list(inner["lower"]), list(inner["upper"])
            inner["lower"][place], inner["upper"][place] = float(low), float(high)
    if whole is not None:
        own = {key: value for key, value in objects.items() if key != "roles"}
        objects["roles"] = {**(objects.get("roles") or {}), role: own}
        objects[AREA[2]] = whole
    return data


def mine(
    bench: TryBench, actor: ActorPort, config: MineConfig, *, out: Path | None = None,
    on_rollout: Callable[[int, bool | None], None] = lambda *_: None,
) -> Mined:  # fmt: skip
    """Search for regions.

    Every scene has its own seed, also those of the confirmation. A failure counts only if the expert solves the scene.

    Args:
        bench: Cores to run episodes with.
        actor: The policy.
        config: What is searched.
        out: Folder for the outcome of each point, written at once, and for bags of two failed scenes of each region;
            the same search in the same folder continues. None: neither.
        on_rollout: Called with the number of each rollout and whether it failed; None: no scene, or unsolvable.

    Raises:
        ConfigError: When the task has no factors, or the folder holds something else than this search.
        PolicyError: When the policy raises.
        RoboximError: On a fault of the simulator.
    """
    factors = factors_of(config.task_config, config.factors)
    log = None if out is None else _Log(out, config, actor)
    points = _Points(bench, actor, config, factors, on_rollout, log)
    regions = search(points.oracle, [factor for factor, _, _ in factors.values()], config.search)
    bags = {r.words: points.recorded(r, out) for r in regions if r.confirmed} if out is not None else {}
    return Mined(
        regions=regions, factors=tuple(factor for factor, _, _ in factors.values()), rollouts=points.rollouts,
        failures=points.failures, unsolved=points.unsolved, infeasible=points.infeasible, bags=bags,
    )  # fmt: skip


class _Log:
    """Outcomes of the points in a search's folder. The points follow from the outcomes, so the search can continue."""

    def __init__(self, folder: Path, config: MineConfig, actor: ActorPort) -> None:
        policy, task = actor.describe(), config.task_config
        search = {
            "config": to_plain(config), "policy": policy.name, "version": policy.version,
            "definitions": definitions_of(cells_of(task), task_files(task)),
        } | ({"placed": role} if (role := role_at_point(task)) else {})  # fmt: skip
        self._key = digest(search)
        require_own(folder, "mine")
        folder.mkdir(parents=True, exist_ok=True)
        self._log = ResultsLog(folder / ROLLOUTS)
        self._known: dict[str, str] = {}
        for entry in self._log.read():
            if entry.key != self._key:
                raise ConfigError(
                    f"{self._log.path} is of another search or policy "
                    f"({differences(entry.data.get('search', {}), search)}); choose another folder"
                )
            self._known |= {entry.data["point"]: entry.data["outcome"]} if "point" in entry.data else {}
        if not self._log.path.exists():
            self._log.append(self._key, {"search": search})

    def outcome(self, number: int, point: list[float], found: Callable[[], str]) -> str:
        """Return what became of a point: by the file, or else by the function, and then it is in the file."""
        name = json.dumps([number, *point])
        if name not in self._known:
            self._known[name] = found()
            self._log.append(self._key, {"point": name, "outcome": self._known[name]})
        return self._known[name]


class _Points:
    def __init__(
        self, bench: TryBench, actor: ActorPort, config: MineConfig,
        factors: dict[str, tuple[Factor, Place, int | None]], on_rollout: Callable[[int, bool | None], None],
        log: _Log | None,
    ) -> None:  # fmt: skip
        self._bench, self._actor, self._config, self._factors = bench, actor, config, factors
        self._on_rollout, self._log = on_rollout, log
        self._data, self._role = parse_yaml(config.task_config), role_at_point(config.task_config)
        self._failed: list[tuple[Array, SeedPath, str]] = []
        self.rollouts = self.unsolved = self.infeasible = 0

    @property
    def failures(self) -> int:
        """Points at which the policy failed."""
        return len(self._failed)

    def oracle(self, points: Array) -> list[bool | None]:
        return [self._fails(point) for point in points]

    def _fails(self, point: Array) -> bool | None:
        number = self.rollouts + self.infeasible
        seed = SeedPath(run_seed=self._config.search.seed, purpose="eval", index=number)
        text = yaml.safe_dump(plain(at_point(self._data, self._factors, point.tolist(), self._role)))

        def played() -> str:
            return self._outcome(seed, text)

        outcome = played() if self._log is None else self._log.outcome(number, point.tolist(), played)
        self.infeasible += outcome == INFEASIBLE
        self.rollouts += outcome != INFEASIBLE
        self.unsolved += outcome == UNSOLVED
        if outcome == FAILURE:
            self._failed.append((point, seed, text))
        failed = {FAILURE: True, SUCCESS: False}.get(outcome)
        self._on_rollout(number, failed)
        return failed

    def _outcome(self, seed: SeedPath, text: str) -> str:
        try:
            draw = self._bench.graph.tasks.draw(seed, text)
        except RoboximError as error:
            if error.code != ErrorCode.RESET_INFEASIBLE:
                raise
            return INFEASIBLE
        if self._bench.run(draw, self._actor, seed, config=self._config.run).success:
            return SUCCESS
        solved = self._bench.run(draw, self._bench.expert, seed, config=self._config.run).success
        return FAILURE if solved else UNSOLVED

    def recorded(self, region: Region, out: Path) -> list[str]:
        """Run up to two failed scenes of a region again, and record them where a stopped search has not done so."""
        names = list(self._factors)
        inside = [
            (seed, text) for point, seed, text in self._failed
            if all(low <= point[names.index(name)] <= high for name, (low, high) in region.bounds.items())
        ]  # fmt: skip
        found = []
        for seed, text in inside[-2:]:
            if (bag := find_episode(out, episode_id(seed))) is not None:
                found.append(bag.relative_to(out).as_posix())
                continue
            draw = self._bench.graph.tasks.draw(seed, text)
            tried = self._bench.run(draw, self._actor, seed, config=replace(self._config.run), bags=out)
            found.append(tried.result.bag)
        return found
