"""Load robot and object models from ``config/`` and from the user's own directories.

A robot or an object is one YAML file. A folder of `objects/` with YAML files of its own is a set of objects, e.g.
``objects/shapes``: its objects are known by their ids like all others, and all of them by the name of the set. They are
no default anywhere, so that a large set changes nothing where it is not named.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path

from roboxim_core import limits
from roboxim_core.config import load_config
from roboxim_core.config_folders import config_dirs, config_sets
from roboxim_core.errors import ConfigError, ErrorCode, nearest, one_of
from roboxim_core.models.description import ObjectModel, RobotModel
from roboxim_core.models.mesh_files import Stamp, file_stamp
from roboxim_core.models.modifiers import ModifierModel, modified
from roboxim_core.models.object_config import ObjectConfig
from roboxim_core.specs import EntitySpec, Scalar, SceneSpec

MAX_MODIFIED = 512
"""Number of modified objects that a library caches: a factor drawn from a range gives every episode its own object."""


class ModelLibrary:
    """The robots and objects of a config directory.

    Returned models are frozen and cached. A robot is read again when its YAML file has changed, an object when one of
    its files has.
    """

    def __init__(self, config_dir: Path | str | None = None) -> None:
        """Make a library.

        Args:
            config_dir: Directory with ``robots/`` and ``objects/``; none: the user's directories, then RoboXim's own
                (`roboxim_core.config.config_dirs`). A file hides later files of the same name.
        """
        self.search_path = (Path(config_dir),) if config_dir is not None else config_dirs()
        self._objects: dict[str, tuple[ObjectConfig, Stamp]] = {}
        self._sets: dict[str, dict[str, Path]] | None = None
        self._modified: dict[tuple[str, Stamp, tuple[tuple[str, Scalar], ...]], ObjectModel] = {}

    @property
    def robot_ids(self) -> tuple[str, ...]:
        """Ids of all robots, sorted."""
        return self._ids("robots")

    @property
    def object_ids(self) -> tuple[str, ...]:
        """Ids of the objects that belong to no set, sorted."""
        return self._ids("objects")

    @property
    def object_sets(self) -> dict[str, tuple[str, ...]]:
        """Name of each set of objects to the ids of its objects, both sorted."""
        return {name: tuple(members) for name, members in self._set_files().items()}

    @property
    def known_objects(self) -> tuple[str, ...]:
        """Ids of all objects: first those that belong to no set, then those of each set."""
        own = self.object_ids
        return tuple(dict.fromkeys((*own, *(name for members in self._set_files().values() for name in members))))

    def expanded(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return ids of objects, with those of a set in place of its name; a name that is an id and a set is an id.

        Args:
            names: Ids and names of sets; unknown ones stay.
        """
        found: list[str] = []
        for name in names:
            members = self._set_files().get(name)
            found += members if members and name not in self.object_ids else [name]
        return tuple(found)

    def robot(self, robot_id: str) -> RobotModel:
        """Return a robot.

        Raises:
            ConfigError: When the id is unknown (the message lists the known ids) or the file is invalid.
        """
        path = self.path("robots", robot_id)
        return _robot(path, file_stamp(path))

    def object(self, object_id: str, modifiers: Mapping[str, Scalar] | None = None) -> ObjectModel:
        """Return an object with its modifiers applied.

        Args:
            object_id: Id, e.g. ``cube``.
            modifiers: Modifier name to value; those left out take the model's default.

        Raises:
            ConfigError: When the id, a modifier or its value is unknown; the message lists the known ones.
        """
        config, stamp = self._object_config(object_id)
        key = (object_id, stamp, tuple(sorted((modifiers or {}).items())))
        if key not in self._modified:
            if len(self._modified) >= MAX_MODIFIED:
                self._modified.pop(next(iter(self._modified)), None)
            model = config.model(object_id, self.path("objects", object_id).parent)
            self._modified[key] = modified(model, config.modifiers, modifiers or {}, f"object '{object_id}'")
        return self._modified[key]

    def entity_model(self, entity: EntitySpec) -> ObjectModel:
        """Return the model of a scene's entity.

        Raises:
            ConfigError: As `object`, and when a joint position names no joint or is beyond its limits.
        """
        model = self.object(entity.model, entity.modifiers)
        joints = {joint.name: joint for joint in model.joints}
        for name, position in entity.joint_positions.items():
            if name not in joints:
                raise ConfigError(f"entity '{entity.name}' has no joint '{name}'; {one_of(joints, name)}")
            if not joints[name].lower - 1e-9 <= position <= joints[name].upper + 1e-9:
                raise ConfigError(
                    f"entity '{entity.name}': joint '{name}' must be from {joints[name].lower:g} "
                    f"to {joints[name].upper:g}, got {position:g}"
                )
        return model

    def object_modifiers(self, object_id: str) -> dict[str, ModifierModel]:
        """Return the modifiers that an object takes.

        Raises:
            ConfigError: When the id is unknown; the message lists the known ids.
        """
        return dict(self._object_config(object_id)[0].modifiers)

    def digest(self, model_id: str) -> str:
        """Return a hash of everything that defines a robot or object: its YAML and the files it names.

        Returns:
            16 hexadecimal digits.

        Raises:
            ConfigError: When the id is unknown; the message lists the known ids.
        """
        kind = "robots" if model_id in self.robot_ids else "objects"
        path = self.path(kind, model_id)
        files = [path, *sorted(p for p in path.with_suffix("").rglob("*") if p.suffix in _ASSETS)]
        if kind == "objects":
            files += sorted(set(_named_files(path)) - set(files))
        return _digest(path.parent, tuple((file, (at := file.stat()).st_size, at.st_mtime_ns) for file in files))

    def hashes(self, scene: SceneSpec) -> dict[str, str]:
        """Return the hashes of a scene's robot and objects, model id to `digest`, as an episode records them.

        Raises:
            ConfigError: When an id is unknown; the message lists the known ones.
        """
        models = dict.fromkeys([scene.robot.model, *(entity.model for entity in scene.entities)])
        return {model: self.digest(model) for model in models}

    def changed(self, recorded: Mapping[str, str]) -> tuple[str, ...]:
        """Return the ids of recorded models that are missing or have changed.

        Args:
            recorded: Result of `hashes` at recording time.
        """
        known = {*self.robot_ids, *self.known_objects}
        return tuple(name for name, digest in recorded.items() if name not in known or self.digest(name) != digest)

    def _ids(self, kind: str) -> tuple[str, ...]:
        return tuple(sorted({path.stem for folder in self.search_path for path in (folder / kind).glob("*.yaml")}))

    def path(self, kind: str, model_id: str) -> Path:
        """Return the YAML file of a model.

        Args:
            kind: ``robots`` or ``objects``.
            model_id: Its id.

        Raises:
            ConfigError: When the id is unknown; the message lists the known ids.
        """
        for folder in self.search_path:
            if not limits.is_file_name(model_id):
                break
            if (path := folder / kind / f"{model_id}.yaml").is_file():
                return path
        if kind != "objects":
            raise ConfigError(
                f"unknown {kind[:-1]} '{model_id}'; {one_of(self._ids(kind), model_id)}", ErrorCode.UNKNOWN_MODEL
            )
        for members in self._set_files().values():
            if model_id in members:
                return members[model_id]
        raise ConfigError(f"unknown object '{model_id}'; {self.objects_like(model_id)}", ErrorCode.UNKNOWN_MODEL)

    def objects_like(self, name: str) -> str:
        """Return the end of an error message about an unknown object: which ids and names of sets are valid."""
        every = (*self.known_objects, *self.object_sets)
        return one_of(every if nearest(every, name) else (*self.object_ids, *self.object_sets), name)

    def _set_files(self) -> dict[str, dict[str, Path]]:
        if self._sets is None:
            self._sets = config_sets("objects", self.search_path)
        return self._sets

    def _object_config(self, object_id: str) -> tuple[ObjectConfig, Stamp]:
        """Return an object's file and the stamp of all files that it names: it is read again when one has changed."""
        path = self.path("objects", object_id)
        try:
            stamp = tuple(file_stamp(file) for file in (path, *_named_files(path)))
            kept = self._objects.get(object_id)
            if kept is None or kept[1] != stamp:
                kept = self._objects[object_id] = _parsed(path, stamp[0]).resolved(path.parent), stamp
        except ConfigError as error:
            named = str(error) if str(path) in str(error) else f"{path}: {error}"
            raise ConfigError(named) from None
        return kept


@lru_cache(maxsize=256)
def _parsed(path: Path, _stamp: tuple[int, int]) -> ObjectConfig:
    """Parse a file once for all libraries and again when it changes: reading YAML dominates the loading time."""
    return load_config(path, ObjectConfig)


@lru_cache(maxsize=64)
def _robot(path: Path, _stamp: tuple[int, int]) -> RobotModel:
    model = load_config(path, RobotModel)
    urdf, srdf = path.parent / model.urdf, path.parent / model.srdf
    pairs = tuple(
        dataclasses.replace(pair, parts=tuple(str(path.parent / part) for part in pair.parts))
        for pair in model.close_pairs
    )
    parts = [("close_pairs", Path(part)) for pair in pairs for part in pair.parts]
    for key, file in (("urdf", urdf), ("srdf", srdf), *parts):
        if not file.is_file():
            raise ConfigError(f"{path}: {key}: no such file: {file}")
    return dataclasses.replace(model, id=path.stem, urdf=urdf, srdf=srdf, close_pairs=pairs)


_ASSETS = {".urdf", ".srdf", ".stl", ".obj", ".mtl", ".glb", ".gltf", ".bin", ".png", ".jpg"}


def _named_files(path: Path) -> tuple[Path, ...]:
    """Return the files that an object's YAML file names, directly or indirectly."""
    stamp = file_stamp(path)
    urdf = _parsed(path, stamp).urdf
    return _files(path, stamp, file_stamp(path.parent / urdf) if urdf else stamp)


@lru_cache(maxsize=256)
def _files(path: Path, stamp: tuple[int, int], _urdf: tuple[int, int]) -> tuple[Path, ...]:
    return _parsed(path, stamp).files(path.parent)


@lru_cache(maxsize=256)
def _digest(folder: Path, files: tuple[tuple[Path, int, int], ...]) -> str:
    """Return the hash of files, given with their sizes and times; the times are only a cache key."""
    hashed = hashlib.blake2b(digest_size=8)
    for file, size, _ in files:
        hashed.update(json.dumps([os.path.relpath(file, folder), size]).encode())
        hashed.update(file.read_bytes())
    return hashed.hexdigest()
