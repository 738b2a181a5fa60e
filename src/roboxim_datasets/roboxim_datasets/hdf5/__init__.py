"""Datasets in the HDF5 layout of robomimic, which robomimic, LIBERO and diffusion_policy read.

A dataset is one file: ``data/demo_N`` holds an episode, ``mask`` the splits. RoboXim puts it into a folder, with files
that state its source and settings.
"""

from roboxim_datasets.hdf5.dataset import Hdf5Format
from roboxim_datasets.hdf5.layout import Hdf5Options
from roboxim_datasets.hdf5.reader import Hdf5Dataset
from roboxim_datasets.hdf5.writer import Hdf5Writer

__all__ = ["Hdf5Dataset", "Hdf5Format", "Hdf5Options", "Hdf5Writer"]
