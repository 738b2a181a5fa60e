"""Dumps of failures: files that hold a query and its outcome, and can be run again.

A dump holds everything that the answer depends on: the scene with its geometry, the request, its seed, the planner's
configuration. Running it again therefore gives the same answer. A time-out depends on the wall clock; it is reproduced
at the same step of the work.
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain, to_plain
from roboxim_core.errors import ConfigError, ErrorCode, RequestTimeoutError, RoboximError, one_of
from roboxim_core.models.description import Shape
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.documents import read_json_object
from roboxim_core.user_folders import cache_dir, expanded
from roboxim_core.whole_files import write_whole
from roboxim_planner.checks import PlannerConfig, no_watch
from roboxim_planner.collisions.geometry import mesh_points
from roboxim_planner.motions.paths import Watch
from roboxim_planner.pipeline import PathIncompleteError, Planner
from roboxim_planner.queries import QUERIES, Answer, Query, run_query
from roboxim_planner.scene import Body, PlanningScene, PointHull

FORMAT = 1
SUFFIX = ".dump.json"
"""End of the names of dumps. Other files in their folder are never listed or removed."""


class Steps:
    """A watch that counts its calls and passes them on."""

    def __init__(self, watch: Watch = no_watch) -> None:
        """Wrap a watch."""
        self._watch = watch
        self.count = 0

    def __call__(self, stage: str, iterations: int) -> None:
        """Count, then call."""
        self.count += 1
        self._watch(stage, iterations)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a query."""

    error_code: int = 0
    """Code of `ErrorCode`; 0: success."""
    error_msg: str = ""
    """Error message; empty after a success."""
    steps: int = 0
    """Number of calls of the watch up to the end."""
    digest: str = ""
    """`Answer.digest`; empty after an error."""

    def __str__(self) -> str:
        """Describe the outcome for a person."""
        return f"{ErrorCode(self.error_code).name}: {self.error_msg}" if self.error_code else f"OK, {self.digest}"


@dataclass(frozen=True, kw_only=True)
class Dump:
    """A query and its outcome."""

    query: Query
    """The query."""
    outcome: Outcome
    """Its answer."""
    config: PlannerConfig
    """The planner's configuration."""
    robot_digest: str
    """`ModelLibrary.digest` of the robot."""

    def run_again(self, library: ModelLibrary, *, deadline: bool = True) -> tuple[Outcome, Answer | None]:
        """Run the query again.

        Args:
            library: Source of the robot model.
            deadline: Stop at the step where the first run timed out or was cancelled; false: let it finish.

        Returns:
            See `answered`.
        """
        return answered(self.query, Planner(library.robot(self.query.robot), self.config), self._watch(deadline))

    def _watch(self, deadline: bool) -> Watch:
        first = self.outcome
        if not deadline or first.error_code not in (ErrorCode.TIMEOUT, ErrorCode.CANCELLED):
            return no_watch
        calls = 0

        def watch(stage: str, iterations: int) -> None:
            nonlocal calls
            calls += 1
            if calls >= first.steps:
                kind = RequestTimeoutError if first.error_code == ErrorCode.TIMEOUT else RoboximError
                raise kind(first.error_msg, ErrorCode(first.error_code))

        return watch


def answered(query: Query, planner: Planner, watch: Watch = no_watch) -> tuple[Outcome, Answer | None]:
    """Run a query; an error becomes an outcome, with the partial answer or none."""
    steps = Steps(watch)
    try:
        answer = run_query(query, planner, steps)
    except RoboximError as error:
        part = Answer(plans=(error.partial,)) if isinstance(error, PathIncompleteError) else None
        return Outcome(error_code=int(error.code), error_msg=str(error), steps=steps.count), part
    return Outcome(steps=steps.count, digest=answer.digest), answer


def self_contained(query: Query) -> Query:
    """Return the query with the points of its hulls in the scene, instead of the names of their files."""
    return replace(query, scene=_embedded(query.scene))


def _embedded(scene: PlanningScene) -> PlanningScene:
    def embed(body: Body) -> Body:
        shapes = tuple(
            PointHull(points=mesh_points(shape.mesh, shape.scale), pose=shape.pose)
            if isinstance(shape, Shape) and shape.kind == "hull"
            else shape
            for shape in body.shapes
        )
        return replace(body, shapes=shapes)

    return replace(
        scene,
        bodies=tuple(embed(body) for body in scene.bodies),
        attached=tuple(replace(held, body=embed(held.body)) for held in scene.attached),
    )


def write_dump(dump: Dump, folder: Path, name: str, *, kept: int) -> Path:
    """Write a dump and remove the oldest ones.

    Args:
        dump: What to write.
        folder: Folder to write to; created if it does not exist.
        name: Beginning of the file's name; sorts by age.
        kept: Largest number of dumps in the folder, >= 1.

    Returns:
        The file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = {
        "format": FORMAT,
        "kind": dump.query.kind,
        "outcome": to_plain(dump.outcome),
        "robot_digest": dump.robot_digest,
        "config": to_plain(dump.config),
        "query": _finite(to_plain(self_contained(dump.query))),
    }
    number = 0
    while (path := folder / f"{name}-{number}{SUFFIX}").exists():
        number += 1
    write_whole(path, json.dumps(data, allow_nan=False))
    for old in list_dumps(folder)[kept:]:
        with contextlib.suppress(OSError):
            old.unlink()
    return path


def read_dump(path: Path) -> Dump:
    """Read a dump.

    Raises:
        ConfigError: If the file cannot be read or is not a dump of this version.
    """
    data = read_json_object(path)
    missing = [key for key in ("query", "outcome", "config", "robot_digest") if key not in data]
    if missing or data.get("format") != FORMAT or str(data.get("kind")) not in QUERIES:
        raise ConfigError(f"{path} is not a planner dump of format {FORMAT}")
    return Dump(
        query=from_plain(data["query"], QUERIES[data["kind"]], source=str(path)),
        outcome=from_plain(data["outcome"], Outcome, source=str(path)),
        config=from_plain(data["config"], PlannerConfig, source=str(path)),
        robot_digest=str(data["robot_digest"]),
    )


def list_dumps(folder: Path) -> list[Path]:
    """Return the dumps of a folder, newest first."""
    dated = []
    for path in folder.glob(f"*{SUFFIX}"):
        with contextlib.suppress(FileNotFoundError):  # another process has removed it
            dated.append((path.stat().st_mtime_ns, path))
    return [path for _, path in sorted(dated, reverse=True)]


def find_dump(name: str, folder: Path) -> Path:
    """Return a dump by its path, its name in the folder, or ``latest``.

    Raises:
        ConfigError: If there is no such dump; the message lists the newest ones.
    """
    dumps = list_dumps(folder)
    if name == "latest" and dumps:
        return dumps[0]
    for path in (expanded(name), folder / name):
        if path.is_file():
            return path
    raise ConfigError(f"no dump '{name}' in {folder}; {one_of((path.name for path in dumps[:10]), name)}")


def dump_folder() -> Path:
    """Return the default folder of dumps: ``roboxim/planner`` in the user's cache folder."""
    return cache_dir() / "planner"


def _finite(data: Any) -> Any:
    """Omit keys with an infinite value, which is their default: JSON has no infinity."""
    if isinstance(data, dict):
        return {k: _finite(v) for k, v in data.items() if not (isinstance(v, float) and math.isinf(v))}
    if isinstance(data, list | tuple):
        return [_finite(item) for item in data]
    return data
