"""Datasets in the RLDS format of TensorFlow Datasets, read and written without TensorFlow.

A dataset is a folder ``<data_dir>/<name>/<version>`` with one Example per episode in sharded TFRecord files,
``features.json`` and ``dataset_info.json``.
"""

from roboxim_datasets.rlds.dataset import RldsFormat, RldsOptions
from roboxim_datasets.rlds.format import RldsEpisode, RldsFeatures
from roboxim_datasets.rlds.reader import RldsDataset, RldsReader
from roboxim_datasets.rlds.writer import RldsWriter

__all__ = [
    "RldsDataset",
    "RldsEpisode",
    "RldsFeatures",
    "RldsFormat",
    "RldsOptions",
    "RldsReader",
    "RldsWriter",
]
