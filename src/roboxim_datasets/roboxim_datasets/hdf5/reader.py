"""Reads HDF5 datasets in robomimic's layout, RoboXim's and others'.

RoboXim's files say where everything is. Of another's file the layout is what most of its episodes have
(`roboxim_datasets.hdf5.others`); the account of the dataset names everything else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError, printable
from roboxim_core.plain_data.documents import parse_json, read_json_object
from roboxim_datasets.account import Account
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.episode import EXECUTED, Episode, ImageSize, Step, Wanted, solved
from roboxim_datasets.files import file_in, has_file, reading
from roboxim_datasets.hdf5.layout import ATTRIBUTE, INSTRUCTIONS, STATISTICS_FILE, SUBTASKS, Hdf5Content
from roboxim_datasets.hdf5.others import (
    Array,
    arrays,
    changed,
    finite_rate,
    is_depth,
    is_one_step_ahead,
    layout_of,
    reason_not_read,
)
from roboxim_datasets.hdf5.splits import masks_of, splits_of
from roboxim_datasets.hdf5.tree import (
    array_in,
    attributes,
    leaves,
    numbers,
    opened,
    problem_of,
    require_no_external_links,
)

_REPEATED = {"dones": "the last step of an episode", "num_samples": "the number of actions"}
_SUCCESS = "success"
_READ_ATTRIBUTES = ("ep_meta", "instruction", "success", ATTRIBUTE)


_LOADING = """```python
from robomimic.utils.dataset import SequenceDataset  # robomimic 0.3
dataset = SequenceDataset(
    "{file}", obs_keys={low} + {rgb}, dataset_keys=["actions"], filter_by_attribute="train"
)
```

`dataset_statistics.json` holds mean, std, min, max and exact quantiles of actions and vectors.
"""


class Hdf5Dataset(Dataset):
    """A dataset. The file is opened for each episode and closed behind it."""

    format = "hdf5"

    def __init__(self, path: Path, *, depth_unit_m: float = 0.0) -> None:
        """Open a dataset.

        Args:
            path: The HDF5 file, or the folder that holds it and no other one.
            depth_unit_m: Unit of the depth images of others [m]; 0: unknown, so they are left out.

        Raises:
            InvalidRequestError: When a unit is stated of RoboXim's own file, which holds metres.
            RecorderError: When there is no such file, or it is damaged or of another layout.
        """
        files = [path] if path.is_file() else sorted([*path.glob("*.hdf5"), *path.glob("*.h5")])
        if len(files) != 1:
            raise RecorderError(f"{path} holds {len(files)} HDF5 files, expected one; name the file")
        super().__init__(path)
        self.depth_unit_m = depth_unit_m
        self.file = files[0].resolve() if path.is_file() else files[0]  # a link that the user names is the user's
        with opened(self.file) as file, reading(self.file):
            require_no_external_links(file, self.file)
            data = file.get("data")
            if not _is_group(data) or not len(data):
                raise RecorderError(f"{self.file} has no episodes 'data/demo_0', ...; it is of another layout")
            self._attributes = attributes(data)
            self._names_of_demos = sorted((name for name in data), key=lambda name: (len(name), name))
            self._unread: dict[str, str] = {}  # episode to why it is not read
            if ATTRIBUTE in self._attributes:
                self.content = self._own_content()
                first = leaves(data[self._names_of_demos[0]])
                keys = (*self.content.cameras, *self.content.vectors, *self.content.signals, "actions")
                self._shapes = {key: tuple(array_in(first, key, self.file).shape[1:]) for key in keys}
            else:
                first = self._look_at_all(data)
            self._compression = next((first[key].compression for key in self.content.cameras), None)
            self._masks = masks_of(file)
        read = [name for name in self._names_of_demos if name not in self._unread]
        self._demos, self._lost_splits, unnamed = splits_of(read, self._masks, own=ATTRIBUTE in self._attributes)
        self._unread |= unnamed

    def _own_content(self) -> Hdf5Content:
        if self.depth_unit_m:
            raise InvalidRequestError(f"{self.file} states the unit of its depth; leave --depth-unit out")
        try:
            content = parse_json(self._attributes[ATTRIBUTE], source=str(self.file))
            return Hdf5Content.from_json(content, str(self.file))
        except (ValueError, TypeError, ConfigError) as error:
            raise RecorderError(f"{self.file}: its description is damaged: {error}", ErrorCode.BAG_DAMAGED) from None

    def _look_at_all(self, data: Any) -> dict[str, Any]:
        """Find the layout from what the episodes have; return the arrays of the first one that fits."""
        found: dict[str, dict[str, Array]] = {}
        for name in self._names_of_demos:
            demo = data.get(name)
            if _is_group(demo):
                found[name] = arrays(leaves(demo))
            else:
                self._unread[name] = "it is no group of arrays"
        layout = layout_of(found, depth=bool(self.depth_unit_m))
        self._unread |= {name: why for name, of in found.items() if (why := layout.problem_of(of))}
        first = next((name for name in found if name not in self._unread), None)
        if first is None:
            name, why = next(iter(self._unread.items()))
            raise RecorderError(
                f"{self.file} has no episode that can be read; {name}: {why}. Expected 'data/demo_0' with 'actions' of "
                "shape (steps, size), and 'obs'"
            )
        self._shapes = dict(layout.shapes)
        self.content = Hdf5Content(
            cameras=layout.cameras,
            vectors=layout.vectors,
            depth=layout.depth,
            outcomes=all(
                _success(data[name], of) is not None for name, of in found.items() if name not in self._unread
            ),
            fps=finite_rate(self._environment.get("control_freq")),
            robot=str(self._attributes.get("robot") or "") or self._robosuite_arm,
        )
        return leaves(data[first])

    @property
    def _robosuite_arm(self) -> str:
        """Name of the only arm of robosuite's environment; empty: none is stated, or several are."""
        robots = self._environment.get("robots")
        named = robots[0] if isinstance(robots, list) and len(robots) == 1 else robots
        return printable(named, 40) if isinstance(named, str) else ""

    @property
    def _environment(self) -> dict[str, Any]:
        """Arguments of robosuite's environment."""
        found = _object(self._attributes.get("env_args", "")).get("env_kwargs")
        return found if isinstance(found, dict) else {}

    @property
    def splits(self) -> Mapping[str, int]:
        """Split to its number of episodes."""
        return {name: len(demos) for name, demos in self._demos.items() if demos}

    @cached_property
    def statistics(self) -> dict[str, Any]:
        """Statistics of actions and vectors; empty when the dataset has none.

        Raises:
            RecorderError: When the file cannot be read.
        """
        folder = self.file.parent
        try:
            return read_json_object(file_in(folder, STATISTICS_FILE)) if has_file(folder, STATISTICS_FILE) else {}
        except ConfigError as error:
            raise RecorderError(str(error), ErrorCode.BAG_DAMAGED) from None

    def summaries(self) -> Mapping[str, Mapping[str, Sequence[float]]]:
        """Return the statistics of actions and observed vectors."""
        columns = {"actions": "action", **self.content.vectors}
        stored = {name: self.statistics[key] for key, name in columns.items() if key in self.statistics}
        return {name: value for name, value in stored.items() if isinstance(value, dict)}

    @property
    def options(self) -> Mapping[str, Any]:
        """Options with which a dataset like this one is written."""
        return {"compression": self._compression} if self._compression in ("lzf", "gzip") else {}

    @property
    def usage(self) -> str:
        """How the dataset is loaded."""
        state = [key.removeprefix("obs/") for key, name in self.content.vectors.items() if name == "state"]
        images = [key.removeprefix("obs/") for key in self.content.cameras]
        return _LOADING.format(file=self.file.name, low=state, rgb=images)

    @cached_property
    def description(self) -> Description:
        """What the attributes and the first episode say."""
        content = self.content
        sizes = {camera: self._shapes[key] for key, camera in content.cameras.items()}
        return Description(
            features=Features(
                cameras={camera: ImageSize(height=shape[0], width=shape[1]) for camera, shape in sizes.items()},
                keys={camera: key.removeprefix("obs/") for key, camera in content.cameras.items()},
                lossless=True,
                depth=tuple(content.depth.values()),
                segmentation=tuple(content.segmentation.values()),
                action=self._names("actions"),
                vectors={name: self._names(key) for key, name in content.vectors.items()},
                signals={name: self._names(key) for key, name in content.signals.items()},
                subtasks=content.subtasks,
            ),
            fps=content.fps,
            robot=content.robot,
            joint_names=content.joint_names,
            semantics=content.semantics,
            outcomes=content.outcomes,
        )

    def _names(self, key: str) -> tuple[str, ...]:
        count = int(np.prod(self._shapes[key]))
        last = key.rpartition("/")[2]
        return self.content.components.get(key) or tuple(f"{last}.{index}" for index in range(count))

    def read(self, split: str, index: int) -> Episode:
        """Read an episode of a split; its steps are read on demand."""
        demo = self._demos[split][index]
        where = f"{self.file}, {demo}"
        with opened(self.file) as file, reading(where):
            group = file["data"][demo]
            attached = attributes(group)
            own = _object(attached.get(ATTRIBUTE, ""))
            length = len(numbers(group.get("actions"), f"{where}, 'actions'", len(array_in(group, "actions", where))))
            stated = _success(group, arrays(leaves(group)))
            if stated is None and "success" not in attached and _readable(group):
                stated = solved(numbers(group["rewards"], f"{where}, 'rewards'", length))
        instructions, subtasks = own.get("instructions"), own.get("subtasks")
        return self.description.episode(
            length=length,
            instruction=self._instruction(attached),
            instructions=[str(text) for text in instructions] if isinstance(instructions, list) else (),
            subtasks=[str(text) for text in subtasks] if isinstance(subtasks, list) else (),
            success=stated,
            metadata=own,
            name="" if ATTRIBUTE in self._attributes else demo,
            read=lambda wanted: self._steps(demo, length, wanted),
        )

    def _instruction(self, attached: Mapping[str, str]) -> str:
        """Return the instruction: RoboXim's, else robocasa's (``ep_meta``), else LIBERO's (``problem_info``)."""
        places = (
            attached.get("instruction"),
            _object(attached.get("ep_meta", "")).get("lang"),
            _object(self._attributes.get("problem_info", "")).get("language_instruction"),
        )
        return next((str(text) for text in places if text), "")

    def _steps(self, demo: str, length: int, wanted: Wanted) -> Iterator[Step]:
        where = f"{self.file}, {demo}"
        with opened(self.file) as file, reading(where):
            yield from self._read_steps(file["data"][demo], length, wanted, where)

    def _read_steps(self, group: Any, length: int, wanted: Wanted, where: str) -> Iterator[Step]:
        content = self.content

        def chosen(names: Mapping[str, str], cameras: tuple[str, ...]) -> dict[str, Any]:
            by_camera = {camera: key for key, camera in names.items()}
            found = {camera: array_in(group, by_camera[camera], where) for camera in cameras}
            for camera, array in found.items():
                flat = names is content.depth and array.ndim == 3  # of others: (steps, height, width)
                if not (array.ndim == 4 or flat) or len(array) < length:
                    problem = f"images of shape {array.shape} for {length} steps"
                    raise RecorderError(f"{where}, '{by_camera[camera]}': {problem}", ErrorCode.BAG_DAMAGED)
            return found

        def rows(key: str) -> Any:
            return numbers(array_in(group, key, where), f"{where}, '{key}'", length)

        images, depth = chosen(content.cameras, wanted.cameras), chosen(content.depth, wanted.depth)
        masks = chosen(content.segmentation, wanted.segmentation)
        actions = rows("actions")
        rewards = rows("rewards")[:, 0] if _readable(group) else np.zeros(length, np.float32)
        vectors = {name: rows(key) for key, name in content.vectors.items()}
        signals = {name: rows(key) for key, name in content.signals.items()}
        executed = signals.pop(EXECUTED, None)
        texts = self._texts(group, rows, INSTRUCTIONS, "instructions", length)
        subtasks = self._texts(group, rows, SUBTASKS, "subtasks", length)
        for index, action in enumerate(actions):
            yield Step(
                index=index,
                images={camera: values[index] for camera, values in images.items()},
                depth={camera: self._metres(values[index]) for camera, values in depth.items()},
                segmentation={camera: values[index][..., 0] for camera, values in masks.items()},
                proprio={name: values[index] for name, values in vectors.items()},
                action=action,
                action_executed=None if executed is None else executed[index],
                signals={name: values[index] for name, values in signals.items()},
                reward=float(rewards[index]),
                instruction=texts[index],
                subtask=subtasks[index],
            )

    def _metres(self, values: Any) -> Any:
        """Return a depth image in metres, shape (height, width)."""
        flat = values if values.ndim == 2 else values[..., 0]
        return flat if not self.depth_unit_m else np.asarray(flat, np.float32) * np.float32(self.depth_unit_m)

    def _texts(self, group: Any, rows: Any, key: str, listed: str, length: int) -> list[str | None]:
        """Return the text of each step that an array of numbers names; None: there is no such array."""
        own = _object(attributes(group).get(ATTRIBUTE, ""))
        if key not in group or ATTRIBUTE not in self._attributes:
            return [None] * length
        return [str(own.get(listed, [])[int(number)]) for number in rows(key)[:, 0]]

    # -- what the file holds

    def _take_stock(self, account: Account) -> None:
        own = ATTRIBUTE in self._attributes
        with opened(self.file) as file, reading(self.file):
            for name in file:
                if name not in ("data", "mask"):
                    account.holds("key", name)
            for name in self._attributes:
                account.holds("metadata", f"data.attrs[{name}]")
                if name in ("env_args", "problem_info", "robot", ATTRIBUTE) and self._attributes[name]:
                    account.reads("metadata", f"data.attrs[{name}]")
                elif name == "total":
                    account.implies("metadata", f"data.attrs[{name}]", "the number of steps")
            for mask, members in self._masks.items():
                account.holds("split", f"mask/{mask}")
                account.leaves_out(
                    "split", f"mask/{mask}", self._lost_splits.get(mask, ""), int(mask in self._lost_splits)
                )
                account.reads("split", f"mask/{mask}")
                for member in sorted((members or set()) - set(self._names_of_demos)):
                    account.holds("episode", f"{member} of mask/{mask}")
                    account.leaves_out("episode", f"{member} of mask/{mask}", "there is no such episode")
            for name in self._names_of_demos:
                account.holds("episode", name)
                if name in self._unread:
                    account.leaves_out("episode", name, self._unread[name])
                account.reads("episode", name)
                demo = file["data"].get(name)
                if _is_group(demo):
                    self._take_stock_of(account, name, demo, own=own)

    def _why_no_depth(self, array: Array) -> str:
        if not self.depth_unit_m:
            return "depth images, whose unit the file does not state (--depth-unit does)"
        return f"depth images of {array.shape[1]} x {array.shape[0]} without a colour camera of that name and size"

    def _take_stock_of(self, account: Account, name: str, demo: Any, *, own: bool) -> None:
        content = self.content
        keys = {*content.cameras, *content.vectors, *content.signals, *content.depth, *content.segmentation, "actions"}
        found = arrays(leaves(demo))
        length = found["actions"].length if "actions" in found else 0
        for attribute in attributes(demo):
            shown = f"demo.attrs[{attribute}]"
            account.holds("metadata", shown)
            if attribute == "num_samples" and _attribute_text(demo, attribute) not in ("", str(length)):
                why = f"it says {_attribute_text(demo, attribute)}, there are {length} actions"
                account.leaves_out("metadata", shown, why, 1)
            elif attribute in _REPEATED:
                account.implies("metadata", shown, _REPEATED[attribute], 1)
            elif attribute in _READ_ATTRIBUTES and name not in self._unread:
                account.reads("metadata", shown, 1)
        for path, array in found.items():
            account.holds("key", path, array.length)
            last = path.rpartition("/")[2]
            if name in self._unread:
                account.leaves_out("key", path, "in an episode that is left out", array.length)
            elif path in keys:
                how = "" if own else changed(path, array)
                if path in content.depth and not own:
                    how = f"{array.dtype} in units of {self.depth_unit_m:g} m, read as metres"
                account.reads("key", path, length, changed=how)
                account.leaves_out("key", path, "after the last action", array.length - length)
            elif path == "rewards" and not array.problem:
                account.reads("key", path, length, changed="" if own else changed(path, array))
            elif path == _SUCCESS and not own and array.length == length and _is_flag(array):
                account.reads("key", path, length, changed="what its last step says")
            elif path in (INSTRUCTIONS, SUBTASKS) and own:
                account.reads("key", path, array.length)
            elif path == "dones" and own:
                account.implies("key", path, _REPEATED[path], array.length)
            elif own and path.startswith("next_") and path.removeprefix("next_") in found:
                account.implies("key", path, "the observations one step ahead", array.length)
            elif path.startswith("next_") and is_one_step_ahead(demo, path, found):
                some = ", images compared in three rows" if len(array.shape) > 1 else ""
                account.implies("key", path, f"the observations one step ahead{some}", array.length - 1)
                account.leaves_out("key", path, "the observation after the last action", 1)
            else:
                why = reason_not_read(path, array) or (
                    self._why_no_depth(array) if is_depth(path, array) else f"most episodes have no such '{last}'"
                )
                account.leaves_out("key", path, f"{why} ({array.dtype}, {_shown(array.shape)})", array.length)


def _attribute_text(demo: Any, attribute: str) -> str:
    return printable(attributes(demo).get(attribute, "").strip("[] "), 40)


def _is_flag(array: Array) -> bool:
    return not array.problem and array.size == 1 and array.dtype.startswith(("bool", "int", "uint", "float"))


def _success(demo: Any, found: Mapping[str, Array]) -> bool | None:
    """Return what an episode says of its success: an attribute, or the last step of an array; None: neither does."""
    stated = attributes(demo)
    if _SUCCESS in stated:
        return _flag(stated[_SUCCESS])
    array, actions = found.get(_SUCCESS), found.get("actions")
    if array is None or actions is None or not actions.length or array.length != actions.length or not _is_flag(array):
        return None
    return bool(numbers(demo[_SUCCESS], f"'{_SUCCESS}'", array.length)[-1, 0] > 0)


def _shown(shape: tuple[int, ...]) -> str:
    return f"{1 + len(shape)}-D"


def _is_group(item: Any) -> bool:
    import h5py

    return isinstance(item, h5py.Group)


def _readable(group: Any) -> bool:
    """Return whether an episode has rewards, one number a step."""
    import h5py

    rewards, actions = group.get("rewards"), group["actions"]
    return isinstance(rewards, h5py.Dataset) and not problem_of(rewards) and rewards.shape[:1] == actions.shape[:1]


def _flag(text: str) -> bool | None:
    """Return what an attribute says; None: it says neither yes nor no."""
    words = {"true": True, "1": True, "1.0": True, "false": False, "0": False, "0.0": False}
    return words.get(text.strip("[] ").lower())


def _object(text: str) -> dict[str, Any]:
    """Return a JSON object; an empty one when the text is none."""
    try:
        value = parse_json(text)
    except ConfigError:
        return {}
    return value if isinstance(value, dict) else {}
