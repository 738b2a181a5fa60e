"""Facts of recorded episodes that reports need: recorded draws, and where the first object started.

Reading them from a bag takes a tenth of a second, so they are stored in ``facts.jsonl`` beside the results. They
survive the loss of the bags.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from roboxim_core.config import digest, from_plain, to_plain
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ConfigError, ErrorCode, RecorderError, TaskError
from roboxim_core.plain_data.differences import differences
from roboxim_core.plain_data.results_log import ResultsLog

FACTS_FILE = "facts.jsonl"
NOT_IN_BAGS = ("wall_s", "inference_s", "bag")
"""Fields of a result that its bag lacks."""


@dataclass(frozen=True, kw_only=True)
class EpisodeFacts:
    """Facts of one episode."""

    episode_id: str
    """The episode."""
    drawn: dict[str, str] = field(default_factory=dict)
    """Named draws of its reset components."""
    start: tuple[float, float] | None = None
    """Place of the task's first object at the start in the world, x and y [m]; none: it has none."""
    explanation: str = ""
    """What happened, in a sentence with numbers; empty: it succeeded, or its conditions are unknown here."""
    scene: str = ""
    """Hash of task and scene without words and image sizes, the same in every run that met the scene;
    empty: stored by an earlier version."""
    robot: tuple[float, float] = (0.0, 0.0)
    """Base of the robot in the world, x and y [m]."""
    robot_yaw_rad: float = 0.0
    """Turn of the base about the world's vertical [rad]."""
    table: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Centre of the table's top in the world, and its extent: x, y, along x, along y [m]."""
    ended: str = ""
    """Hash of the result in the bag, see `ended`; empty: stored by an earlier version."""

    @property
    def start_from_robot(self) -> tuple[float, float] | None:
        """The start in the frame of the robot's base: x away from the robot, y to its left [m]."""
        return None if self.start is None else self._from_robot(*self.start)

    @property
    def table_from_robot(self) -> tuple[float, float, float, float] | None:
        """The table in the frame of the robot's base; none: its edges are not parallel to that frame's axes."""
        x, y, along_x, along_y = self.table
        quarters = self.robot_yaw_rad / (math.pi / 2)
        if abs(quarters - round(quarters)) > 1e-6:
            return None
        sides = (along_y, along_x) if round(quarters) % 2 else (along_x, along_y)
        return (*self._from_robot(x, y), *sides)

    def _from_robot(self, x: float, y: float) -> tuple[float, float]:
        """Return a place of the world in the frame of the robot's base, to the micrometre [m]."""
        x, y = x - self.robot[0], y - self.robot[1]
        cos, sin = math.cos(self.robot_yaw_rad), math.sin(self.robot_yaw_rad)
        return round(cos * x + sin * y, 6), round(cos * y - sin * x, 6)


def episode_facts(
    folder: Path, results: Iterable[EpisodeResult], *, bags: Path | None = None
) -> dict[str, EpisodeFacts]:
    """Return the facts of a run's episodes by episode id; those without a bag and stored facts are left out.

    Args:
        folder: The run's folder, in which facts are stored.
        results: Its results.
        bags: Folder with the bags, under their paths in the run; none: the run's.

    Raises:
        ConfigError: When the stored facts are damaged.
        RecorderError: With code ``BAG_DAMAGED`` when a bag is incomplete, or its end differs from its result.
    """
    log = ResultsLog(folder / FACTS_FILE)
    found = {entry.key: _loaded(entry.data, str(log.path)) for entry in log.read()}
    bags = folder if bags is None else bags
    for result in results:
        known = result.episode_id in found and found[result.episode_id].scene
        if not known and result.bag and (bags / result.bag).exists():
            found[result.episode_id] = _facts(bags / result.bag)
            log.append(result.episode_id, _stored(found[result.episode_id]))
        facts = found.get(result.episode_id)
        if facts and facts.ended not in ("", ended(result)):
            raise RecorderError(
                f"the result of episode {result.episode_id} in {folder} differs from its bag's {result.bag} "
                f"({_difference(bags / result.bag, result)}): the result, the bag or {FACTS_FILE} was changed; restore "
                "it, or run again with --repair or repair=True after removing the bag, which repeats the episode",
                ErrorCode.BAG_DAMAGED,
            )
    return found


def _stored(facts: EpisodeFacts) -> dict[str, Any]:
    """Return facts as they are stored: the explanation is ``told`` there, as in the files of earlier versions."""
    return {"told" if name == "explanation" else name: value for name, value in to_plain(facts).items()}


def _loaded(stored: Mapping[str, Any], source: str) -> EpisodeFacts:
    plain = {"explanation" if name == "told" else name: value for name, value in stored.items()}
    facts: EpisodeFacts = from_plain(plain, EpisodeFacts, source=source)
    return facts


def ended(result: EpisodeResult) -> str:
    """Return the hash of how an episode ended; without times and the bag's path, which the bag itself does not have."""
    return digest(_lasting(result))


def _lasting(result: EpisodeResult) -> dict[str, Any]:
    return {name: value for name, value in to_plain(result).items() if name not in NOT_IN_BAGS}


def _difference(bag: Path, result: EpisodeResult) -> str:
    """Return in words where a result and its bag differ."""
    from roboxim_recorder.bag import BagReader

    if not bag.exists():
        return "the bag is gone, its facts were stored"
    stored = _lasting(BagReader(bag).result)
    return differences(stored, _lasting(result), words=("in the bag", "in the results")) or "the stored facts"


def _facts(bag: Path) -> EpisodeFacts:
    from roboxim_recorder.bag import BagReader
    from roboxim_runs.episodes.course import Course

    reader = BagReader(bag)
    info, base, table = reader.info, reader.info.scene.robot.pose, reader.info.scene.table
    ahead = base.rotation.apply((1.0, 0.0, 0.0))
    explanation = ""
    if reader.result.outcome == "failure":
        with contextlib.suppress(TaskError, ConfigError):  # a skill that this program does not have
            explanation = Course.of(bag).explanation
    return EpisodeFacts(
        episode_id=info.episode_id, drawn=dict(info.task.drawn), start=_start(info),
        explanation=explanation, scene=scene_hash(info),
        robot=(float(base.position[0]), float(base.position[1])), robot_yaw_rad=math.atan2(ahead[1], ahead[0]),
        table=(table.center[0], table.center[1], table.size[0], table.size[1]),
        ended=ended(reader.result),
    )  # fmt: skip


def scene_hash(info: EpisodeInfo) -> str:
    """Return the hash of an episode's task and scene, without the words of the task and the sizes of images."""
    scene = to_plain(info.scene)
    scene["cameras"] = [
        {key: value for key, value in camera.items() if key not in ("width", "height")} for camera in scene["cameras"]
    ]
    met = [info.task.skill, to_plain(info.task.objects), to_plain(info.task.arguments), scene]
    return hashlib.blake2b(json.dumps(met, sort_keys=True, default=str).encode(), digest_size=8).hexdigest()


def _start(info: EpisodeInfo) -> tuple[float, float] | None:
    roles = info.task.objects
    first = roles.get("target") or next(iter(roles.values()), None)
    entity = next((e for e in info.scene.entities if first is not None and e.name == first.entity), None)
    if entity is None:
        return None
    return float(entity.pose.position[0]), float(entity.pose.position[1])
