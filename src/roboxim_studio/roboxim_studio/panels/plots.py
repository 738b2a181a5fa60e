"""Plots of an episode: actions, joints, gripper, measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from viser import uplot

from roboxim_studio.episode.film import Film
from roboxim_studio.episode.statistics import Distribution
from roboxim_studio.panels import markup

COLOURS = ("#1c7ed6", "#e8590c", "#2f9e44", "#ae3ec9", "#e03131", "#0c8599", "#868e96", "#f08c00")
DELTAS = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Curves over the ticks of an episode."""

    title: str
    """What is shown, with its unit."""
    names: tuple[str, ...]
    """Name of each curve."""
    values: tuple[npt.NDArray[np.float64], ...]
    """Values of each curve at every tick; NaN: none."""

    def data(self) -> tuple[npt.NDArray[np.float64], ...]:
        """Return the ticks and the curves."""
        return (np.arange(len(self.values[0]), dtype=np.float64), *self.values)

    def series(self) -> tuple[uplot.Series, ...]:
        """Return how each curve is drawn."""
        curves = (
            uplot.Series(label=name, stroke=COLOURS[number % len(COLOURS)], width=1.5)
            for number, name in enumerate(self.names)
        )
        return (uplot.Series(label="tick"), *curves)


def plots_of(film: Film) -> tuple[Plot, ...]:
    """Return the plots of an episode; measures are those that change."""
    states = film.states
    joints = np.array([state.robot.joint_positions for state in states], dtype=float)
    gripper = np.array([(s.robot.gripper_opening, s.robot.gripper_command) for s in states], dtype=float)
    plots = [
        *_actions(film),
        Plot(title="joints [rad]", names=states[0].robot.joint_names, values=tuple(joints.T)),
        Plot(title="gripper, 1 = open", names=("measured", "commanded"), values=tuple(gripper.T)),
    ]
    return (*plots, *_measures(film))


def _actions(film: Film) -> Sequence[Plot]:
    width = max((len(state.action_executed) for state in film.states), default=0)
    if not width:
        return ()
    rows = np.full((len(film), width), np.nan)
    for number, state in enumerate(film.states):
        if state.action_executed:
            rows[number] = state.action_executed
    arm, names = rows[:, :-1], (DELTAS if width == 7 else tuple(f"joint {n + 1}" for n in range(width - 1)))
    if width != 7 or film.info.semantics.control.is_joint_space:
        return (Plot(title="action, arm joints [rad]", names=tuple(names[: width - 1]), values=tuple(arm.T)),)
    return (
        Plot(title="action, translation [m]", names=DELTAS[:3], values=tuple(arm[:, :3].T)),
        Plot(title="action, rotation [rad]", names=DELTAS[3:6], values=tuple(arm[:, 3:].T)),
    )


def _measures(film: Film) -> Sequence[Plot]:
    verdicts = film.verdicts
    names = dict.fromkeys(name for verdict in verdicts for name in verdict.predicates)
    found = []
    for name in names:
        values = np.array([verdict.predicates.get(name, np.nan) for verdict in verdicts], dtype=float)
        lamp = set(np.unique(values[~np.isnan(values)]).tolist()) <= {0.0, 1.0}
        if not lamp and np.nanmax(values) - np.nanmin(values) > 1e-6:
            found.append(Plot(title=name, names=(name,), values=(values,)))
    return found


def add_distributions(gui: Any, shown: Sequence[Distribution], title: str) -> None:
    """Add histograms of actions to the current container, with their numbers.

    Args:
        gui: The page's inputs.
        shown: Distributions.
        title: What they are of.
    """
    rows = [(one.name, f"{one.mean:.4g} ± {one.deviation:.3g}, {one.lowest:.4g} to {one.highest:.4g}") for one in shown]
    gui.add_html(markup.facts([(title, "mean ± deviation, range"), *rows], "action-facts"))
    for number, one in enumerate(shown):
        curve = uplot.Series(label="actions", stroke=COLOURS[number % len(COLOURS)], width=1.5)
        gui.add_uplot(
            one.outline, (uplot.Series(label=one.name), curve), title=one.name, height=120,
            scales={"x": uplot.Scale(time=False)},
        )  # fmt: skip
