"""Datasets in the LeRobot format, versions 3.0 and 2.1, read and written without lerobot and torch.

A dataset is a folder with ``meta/info.json``, Parquet files of numbers in ``data/`` and videos in ``videos/``.
"""

from roboxim_datasets.lerobot.content import LeRobotContent, LeRobotOptions
from roboxim_datasets.lerobot.dataset import LeRobotFormat
from roboxim_datasets.lerobot.layout import LeRobotLayout
from roboxim_datasets.lerobot.reader import LeRobotDataset
from roboxim_datasets.lerobot.writer import LeRobotWriter

__all__ = ["LeRobotContent", "LeRobotDataset", "LeRobotFormat", "LeRobotLayout", "LeRobotOptions", "LeRobotWriter"]
