"""Experiments: configuration -> cells -> design and stages -> outcomes -> scores and verdicts. Plain values, no ROS."""

from roboxim_eval.experiments.analysis import Analysis, Outcomes, analyse
from roboxim_eval.experiments.cells import Cell, cells_of, chosen, mix_of
from roboxim_eval.experiments.config import ExperimentConfig
from roboxim_eval.experiments.cost import Cost, Rates, SideBySide, cost_of
from roboxim_eval.experiments.design import Design, Stage, design_of, stages_of
from roboxim_eval.experiments.loading import experiment_config, scale_names

__all__ = [
    "Analysis",
    "Cell",
    "Cost",
    "Design",
    "ExperimentConfig",
    "Outcomes",
    "Rates",
    "SideBySide",
    "Stage",
    "analyse",
    "cells_of",
    "chosen",
    "cost_of",
    "design_of",
    "experiment_config",
    "mix_of",
    "scale_names",
    "stages_of",
]
