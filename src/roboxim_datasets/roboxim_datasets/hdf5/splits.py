"""The splits of an HDF5 dataset, which its masks define: lists of the names of episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from roboxim_datasets.dataset import SPLITS
from roboxim_datasets.files import reading
from roboxim_datasets.hdf5.layout import MASKS
from roboxim_datasets.hdf5.tree import text_of

_SPLITS = {mask: split for split, mask in MASKS.items()}
Masks = Mapping[str, set[str] | None]
"""Mask to the names that it lists; None: it is not a list of names."""


class Splits(NamedTuple):
    """The episodes of each split, and what belongs to none."""

    episodes: dict[str, list[str]]
    """Split to the names of its episodes."""
    lost: dict[str, str]
    """Mask to the reason why it is not a split."""
    unnamed: dict[str, str]
    """Episode that no mask names to the reason why it is left out."""


def splits_of(names: Sequence[str], masks: Masks, *, own: bool) -> Splits:
    """Divide episodes by masks.

    Without masks all episodes are in ``train``. Episodes in no mask are too, unless there is a mask ``train``.

    Args:
        names: Episodes that can be read, in their order.
        masks: The masks of the file.
        own: Whether RoboXim wrote the file: then every mask is a split.
    """
    found: dict[str, list[str]] = {}
    lost: dict[str, str] = {}
    taken: set[str] = set()
    named_masks = {_SPLITS.get(mask, mask): mask for mask in masks}
    order = tuple(dict.fromkeys((*SPLITS, *named_masks))) if own else SPLITS
    for mask, members in masks.items():
        if _SPLITS.get(mask, mask) not in order:
            lost[mask] = "not one of train, valid, test"
        elif members is None:
            lost[mask] = "not a list of names"
    for split in order:
        named = masks.get(named_masks.get(split, "")) or set()
        found[split] = [name for name in names if name in named and name not in taken]
        taken |= set(found[split])
    rest = [name for name in names if name not in taken]
    unnamed: dict[str, str] = {}
    if named_masks.get("train") in lost or "train" not in named_masks or not taken:
        found["train"] = sorted([*found["train"], *rest], key=names.index)
    else:
        unnamed = dict.fromkeys(rest, "no mask names it, and there is a mask 'train'")
    return Splits({name: found[name] for name in order if found[name]}, lost, unnamed)


def masks_of(file: Any) -> dict[str, set[str] | None]:
    """Return mask to the names that it lists; None: it is no list of names."""
    import h5py

    group = file.get("mask")
    if not isinstance(group, h5py.Group):
        return {}
    found: dict[str, set[str] | None] = {}
    for mask in group:
        item = group.get(mask)
        listed = isinstance(item, h5py.Dataset) and item.ndim == 1 and item.dtype.kind in "SO" and not item.external
        if listed and len(item) <= max(1, item.id.get_storage_size()):
            with reading(f"mask/{mask}"):
                found[mask] = {text_of(name) for name in item[:]}
        else:
            found[mask] = None
    return found
