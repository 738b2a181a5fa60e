"""Collects the content of a recorded episode's page: its bag, its run's log, and other episodes of the same scene."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import takewhile
from pathlib import Path

import numpy as np

from roboxim_core.episode import Draw, EpisodeInfo, EpisodeRunner, RunConfig
from roboxim_core.errors import ConfigError, RoboximError, TaskError
from roboxim_core.plain_data.shell import shell_line
from roboxim_core.rates import ticks
from roboxim_eval.film_options import FilmOptions
from roboxim_eval.report.charts.course import Curve
from roboxim_eval.report.course import Floats
from roboxim_eval.report.episode import EpisodePage, OtherWay, Signals
from roboxim_eval.report.films import Film, film_strip
from roboxim_runs.answers.trying import GivenScene
from roboxim_runs.episodes.course import Course
from roboxim_runs.episodes.pictures import film
from roboxim_runs.storage.folder import EPISODE_MARK

FILM_HEIGHT = 360
"""Largest height of a frame [px]."""
KEPT = 64
"""Number of episodes whose films and courses are kept: pages of one scene show the same ones."""
EXPERT_S = 60.0
"""Longest time of the expert in a scene [s]."""
NOTHING_PRINTED = (
    "Its worker printed nothing in this episode; what a policy behind a server prints is in the server's log."
)
MAX_LOG_LINES = 400
"""Largest number of lines of the policy's output; the first and the last ones are shown."""
NOBODY = "No other policy acted in this scene; roboxim show {} --expert adds the expert's plan."
_NODE_LINE = re.compile(r"\[(DEBUG|INFO|WARN|ERROR|FATAL)\] \[[\d.]+\] \[")


@dataclass(frozen=True, kw_only=True)
class Other:
    """An episode of another actor in the same scene."""

    name: str
    """The actor."""
    bag: Path
    """Its bag."""
    link: str = ""
    """Address of its own page; empty: it has none."""


def shown_episode(
    bag: Path, *, films: FilmOptions | None, others: Sequence[Other] = (), shown_as: str = "", name: str = "",
    run: Path | None = None,
) -> EpisodePage:  # fmt: skip
    """Return the page of a recorded episode.

    Args:
        bag: Its bag.
        others: Episodes of others in the same scene.
        shown_as: The bag, as commands of the page name it; empty: ``bag``.
        films: How the report beside it shows films; none: its images are not read.
        name: Name of its policy; empty: as the bag has it.
        run: Its run's folder, with the logs; none: that of the bag.

    Raises:
        ConfigError: When the path is not a bag.
        RecorderError: With code ``BAG_DAMAGED``.
    """
    course = _course(bag)
    info, result, notes = course.info, course.result, []
    try:
        conditions, explanation = course.conditions, course.explanation
    except (TaskError, ConfigError) as error:  # of a skill that this program does not have
        conditions, explanation = (), ""
        notes.append(f"What it was judged by is not known here: {error}")
    log, log_note = printed(run or bag.parent.parent, result.index)
    where = shell_line(shown_as or bag)
    commands = (
        f"roboxim studio {where}   # in 3D, tick by tick\n"
        f"roboxim show {where} --out why.html\nroboxim up                       # in one terminal\n"
        f"roboxim replay {where}   # in another: executes it again and compares every tick"
    )
    return EpisodePage(
        episode_id=info.episode_id, actor=name or info.actor, instruction=info.task.instruction or info.task.skill,
        outcome=result.outcome, reason=result.reason, explanation=explanation,
        message=result.message, steps=result.steps, ticks=len(course.ticks),
        tick_s=1.0 / info.scene.control_rate_hz, conditions=conditions,
        signals=signals_of(course), held=held_objects(info), facts=_facts(info), commands=commands,
        film=_full(bag, films), others=[_other(one, films) for one in others],
        nobody="" if others else NOBODY.format(where), log=log, log_note=log_note, notes=notes,
    )  # fmt: skip


@lru_cache(maxsize=KEPT)
def films_of(bag: Path, options: FilmOptions) -> tuple[Film, Film] | None:
    """Return an episode's film for a report, and that with all its frames at its own rate; None: it has no cameras.

    Args:
        bag: Its bag.
        options: How a report shows films.
    """
    frames = film(bag, every=1)
    if not frames:
        return None
    tick_ms = 1000.0 / _course(bag).info.scene.control_rate_hz
    return (
        film_strip(frames, max_frames=options.frames, height=options.height),
        film_strip(frames, max_frames=None, height=FILM_HEIGHT, frame_ms=tick_ms),
    )


@lru_cache(maxsize=KEPT)
def _course(bag: Path) -> Course:
    return Course.of(bag)


def forget_episodes() -> None:
    """Forget the kept films and courses: another run may have recorded bags of the same names since."""
    films_of.cache_clear()
    _course.cache_clear()


def _full(bag: Path, films: FilmOptions | None) -> Film | None:
    found = films_of(bag, films) if films else None
    return found[1] if found else None


def _other(other: Other, films: FilmOptions | None) -> OtherWay:
    course = _course(other.bag)
    try:
        explanation = course.explanation
    except (TaskError, ConfigError):  # the page of the episode itself says so
        explanation = ""
    return OtherWay(
        name=other.name, outcome=course.result.outcome, text=explanation or f"{course.result.steps} actions.",
        film=_full(other.bag, films), link=other.link,
    )  # fmt: skip


def signals_of(course: Course) -> list[Signals]:
    """Return action, gripper, tool and joints of an episode, tick by tick."""
    states = [tick.state.robot for tick in course.ticks]
    joints = states[0].joint_names
    names = course.info.semantics.component_names(joints)
    executed, label = (
        _rows([getattr(tick.step, kind) for tick in course.ticks], len(names))
        for kind in ("action_executed", "action_label")
    )
    same = np.array_equal(executed, label, equal_nan=True)
    tool = np.array([state.pose_tcp_measured.position for state in states], float)
    commanded = np.array([state.pose_tcp_commanded.position for state in states], float)
    return [
        Signals(
            name="Action", about="" if same else "First line: executed. Second: the label, without injected noise.",
            curves=[
                Curve(name=name, lines=(executed[:, n],) if same else (executed[:, n], label[:, n]))
                for n, name in enumerate(names)
            ],
        ),
        Signals(
            name="Gripper", about="1 is open. First line: measured. Second: commanded.",
            curves=[Curve(
                name="opening",
                lines=(np.array([s.gripper_opening for s in states]), np.array([s.gripper_command for s in states])),
            )],
        ),
        Signals(
            name="Tool centre point", about="In the world. First line: measured. Second: commanded.",
            curves=[
                Curve(name=axis, lines=(tool[:, n], commanded[:, n]), measure=f"{axis}_m")
                for n, axis in enumerate("xyz")
            ],
        ),
        Signals(
            name="Joints", about="Measured positions.",
            curves=[
                Curve(name=name, lines=(np.array([s.joint_positions[n] for s in states]),), measure=f"{name}_rad")
                for n, name in enumerate(joints)
            ],
        ),
    ]  # fmt: skip


def _rows(found: Sequence[Sequence[float]], width: int) -> Floats:
    """Return vectors as rows; NaN where a tick has none, as tick 0 has no action."""
    return np.array([row if len(row) == width else [np.nan] * width for row in found], float)


def held_objects(info: EpisodeInfo) -> list[dict[str, str]]:
    """Return a row for each object of the scene: its role, model and place."""
    roles = {thing.entity: (role, thing) for role, thing in info.task.objects.items()}
    rows = []
    for entity in info.scene.entities:
        role, thing = roles.get(entity.name, ("", None))
        x, y, z = entity.pose.position
        changed = ", ".join(f"{key} {value}" for key, value in entity.modifiers.items())
        rows.append({
            "object": thing.name if thing else entity.name, "role": role.replace("_", " ") or "none",
            "model": f"{entity.model}{f' ({changed})' if changed else ''}", "x, y, z [m]": f"{x:.3f}, {y:.3f}, {z:.3f}",
        })  # fmt: skip
    return rows


def _facts(info: EpisodeInfo) -> dict[str, str]:
    scene = info.scene
    return {
        "episode": info.episode_id, "policy": f"{info.actor} {info.actor_version}".strip(), "robot": scene.robot.model,
        "drawn": ", ".join(f"{name}: {value}" for name, value in info.task.drawn.items()) or "nothing",
        "cameras": ", ".join(f"{one.name} {one.width} x {one.height}" for one in scene.cameras) or "none",
        "lights": str(len(scene.look.lights)), "table": scene.look.table.texture or "plain",
        "control rate": f"{scene.control_rate_hz:g} Hz", "renderer": info.renderer or "none",
        "action": f"{info.semantics.control}, {info.semantics.frame} frame",
    }  # fmt: skip


def printed(run: Path, index: int) -> tuple[str, str]:
    """Return what a policy printed in an episode, and why that is not known; one of them is empty.

    Args:
        run: The run's folder.
        index: The episode's index in the run.
    """
    mark = EPISODE_MARK.format(index)
    logs = sorted((run / "logs").glob("worker-*.log"), key=lambda log: log.stat().st_mtime_ns, reverse=True)
    for log in logs:
        lines = log.read_text(errors="replace").splitlines()
        if mark not in lines:
            continue
        start = len(lines) - lines[::-1].index(mark)  # the last attempt
        printed = list(takewhile(lambda line: not line.startswith(("--- episode ", "nanobind: leaked")), lines[start:]))
        printed = [line for line in printed if not _NODE_LINE.match(line)]
        if len(printed) > MAX_LOG_LINES:
            half = MAX_LOG_LINES // 2
            printed = [
                *printed[:half],
                f"... {len(printed) - MAX_LOG_LINES} lines left out; all are in {log.name}",
                *printed[-half:],
            ]
        return (
            "\n".join(printed),
            "" if printed else NOTHING_PRINTED,
        )
    if not logs:
        return "", "The logs of its run are not beside its bag."
    return "", "The logs of its run do not separate episodes: it ran elsewhere, or with an earlier version."


def expert_way(info: EpisodeInfo, folder: Path) -> Other:
    """Plan and execute the expert in an episode's scene, and record that.

    Args:
        info: The episode.
        folder: An empty folder for the bag.

    Raises:
        RoboximError: When the scene cannot be built here.
    """
    from roboxim_bringup.core_graph import CoreGraph

    config = RunConfig(
        run_seed=info.run_seed, purpose=info.purpose, rate_hz=info.scene.control_rate_hz, output_dir=str(folder)
    )
    drawn = Draw(task=info.task, scene=info.scene, max_steps=ticks(EXPERT_S, info.scene.control_rate_hz))
    with CoreGraph(folder) as graph:
        ports = replace(graph.ports, scenes=GivenScene(drawn))
        result = EpisodeRunner(ports, config).run_index(info.index)
    if not result.bag:
        raise RoboximError(f"the expert has no way in this scene: {result.message or result.reason}")
    return Other(name="expert, planned now", bag=folder / result.bag)
