"""Policies of an evaluation: their names, checkpoints and options."""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import roboxim_policies.builtin
from roboxim_bringup.graph import PolicyLaunch
from roboxim_bringup.parameters import parse_options
from roboxim_core.conventions import load_convention
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.policies import Policy
from roboxim_policies import POLICIES
from roboxim_policies.base import find_policy, load_policy, require_arguments
from roboxim_policies.identity import location_free, policy_files
from roboxim_policies.learning.checkpoint_file import checkpoint_file, read_description
from roboxim_policies.learning.families import FAMILIES
from roboxim_policies.remote import SERVERS_OWN, RemotePolicy
from roboxim_policies.wires import REFUSED
from roboxim_runs.policies.here import OwnPolicy, own_policy

EXPERT = "expert"
REWORDED = "reworded"
CHECKPOINT = "checkpoint"
NAME = r"\w[\w-]*"


LONGEST_NAME = 100
"""Largest number of characters of a policy's name, which is also a folder's name."""
LONGEST_FILE_NAME = 255


@dataclass(frozen=True, kw_only=True)
class PolicySpec:
    """A policy by name, as plain data."""

    spec: str
    """Registered name, ``module:Class``, ``path/to/file.py:Class`` or ``expert``."""
    name: str = ""
    """Name in the report and of its folder; empty: the registered name or the class's name."""
    options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of its class, e.g. ``{"checkpoint": "runs/bc"}``."""


@dataclass(frozen=True, kw_only=True)
class ChosenPolicy(PolicySpec):
    """A policy whose class has been found."""

    make: Callable[..., Policy] | None = None
    """Its class or factory; none for the expert."""
    own: OwnPolicy | None = None
    """The caller's class or instance, which this process serves; none: each worker makes the policy."""

    @property
    def launch(self) -> PolicyLaunch | None:
        """Launch of the policy in a worker; none for the expert, which the task node serves."""
        return None if self.make is None else PolicyLaunch(spec=self.spec, options=self.options)

    @property
    def acting(self) -> ChosenPolicy:
        """The policy that decides on the actions: itself, or the one to which ``reworded`` gives other words.

        Raises:
            ConfigError: When there is no such policy.
            PolicyError: When its module raises.
        """
        inner = self.options.get("policy")
        if self.spec != REWORDED or not isinstance(inner, str):
            return self
        other_words = ("policy", "instruction", "wordings")
        options = {key: value for key, value in self.options.items() if key not in other_words}
        return replace(self, spec=inner, options=options, make=find_policy(inner)).acting

    @property
    def takes_checkpoint(self) -> bool:
        """Whether its class has an argument ``checkpoint``."""
        return self.make is not None and CHECKPOINT in inspect.signature(self.make).parameters

    @property
    def is_checkpoint(self) -> bool:
        """Whether it is known to come from a training: it has a checkpoint, or a server computes its actions."""
        acting = self.acting
        return acting.is_remote or bool(acting.options.get(CHECKPOINT))

    @property
    def is_remote(self) -> bool:
        """Whether a server computes its actions."""
        if self.make is None:
            return False
        made = (
            self.make if isinstance(self.make, type) else inspect.signature(self.make, eval_str=True).return_annotation
        )
        return isinstance(made, type) and issubclass(made, RemotePolicy)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that the policy needs, as far as known without an instance of it."""
        if self.acting is not self:
            return self.acting.cameras
        if self.spec in FAMILIES:
            return tuple(read_description(Path(self.options[CHECKPOINT])).get("camera_sizes", ()))
        convention = self.options.get("convention")
        if self.is_remote and isinstance(convention, str) and convention != SERVERS_OWN:
            return tuple(camera.name for camera in load_convention(convention).cameras)
        cameras = getattr(self.make, "cameras", ())
        cameras = (cameras,) if isinstance(cameras, str) else cameras
        if not isinstance(cameras, list | tuple):  # a property, or an unrelated attribute of a user's class
            return ()
        return tuple(name for camera in cameras if isinstance(name := getattr(camera, "name", camera), str))

    @property
    def robot(self) -> str:
        """Robot that the policy was trained with; empty when unknown."""
        acting = self.acting
        return (
            str(read_description(Path(acting.options[CHECKPOINT])).get("robot", "")) if acting.spec in FAMILIES else ""
        )

    @property
    def camera_views(self) -> dict[str, tuple[str, ...]]:
        """Camera to the files of ``config/cameras`` from whose places it saw in the training; empty when unknown."""
        acting = self.acting
        if acting.spec not in FAMILIES:
            return {}
        found = read_description(Path(acting.options[CHECKPOINT])).get("camera_views", {})
        return {str(camera): tuple(map(str, views)) for camera, views in found.items()}

    def files(self, out: Path) -> dict[str, str]:
        """Return the files that define the policy, see `policy_files`, without those in the results' folder."""
        acting = self.acting
        if self.own is not None:
            return self.own.files()
        return {} if acting.make is None else policy_files(acting.spec, acting.make, acting.options, exclude=out)

    def identity(self, out: Path) -> dict[str, Any]:
        """Return what defines the policy: its specification, options and files; see `files`."""
        return {**location_free(self.spec, self.options), "files": self.files(out)}


def choose_policies(
    policies: Sequence[str], checkpoints: Sequence[str] = (), options: Sequence[str] = ()
) -> list[ChosenPolicy]:
    """Parse the command line's options, and find each policy without making an instance.

    Args:
        policies: ``[NAME=]SPEC``; the default name is the class's or the registered one.
        checkpoints: ``[NAME=]PATH``; without a name, for the policies that take a checkpoint and have no other.
        options: ``[NAME.]KEY=VALUE``; without a name, for the first policy.

    Raises:
        ConfigError: When names are equal, a policy is unknown, or a policy does not take its options.
        PolicyError: When a policy's module raises, with the location.
    """
    chosen = _by_name([_named(word) for word in policies])
    for name, given in _options(list(chosen), options).items():
        chosen[name] = replace(chosen[name], options=given)
    for name, path in _checkpoints(chosen, checkpoints).items():
        chosen[name] = replace(chosen[name], options={**chosen[name].options, CHECKPOINT: path})
    return [_checked(policy) for policy in chosen.values()]


def find_policies(policies: Sequence[Any]) -> list[ChosenPolicy]:
    """Find each policy without making an instance.

    Args:
        policies: Policies; a text is ``[NAME=]SPEC``. A class or an instance is a policy of this process.

    Raises:
        ConfigError: When names are equal, a policy is unknown, or a policy does not take its options.
        PolicyError: When a policy's module raises, with the location.
    """
    return [_checked(policy) for policy in _by_name([_found(policy) for policy in policies]).values()]


def _found(policy: Any) -> ChosenPolicy:
    if isinstance(policy, ChosenPolicy):
        return policy
    if isinstance(policy, str):
        return _named(policy)
    if not isinstance(policy, PolicySpec):
        own = own_policy(policy)
        return ChosenPolicy(name=own.cls.__name__, spec=own.spec, make=own.cls, own=own)
    chosen = _chosen(policy.name, policy.spec) if policy.name else _named(policy.spec)
    return replace(chosen, options=dict(policy.options))


def _by_name(policies: Sequence[ChosenPolicy]) -> dict[str, ChosenPolicy]:
    chosen: dict[str, ChosenPolicy] = {}
    for policy in policies:
        if policy.name in chosen:
            raise ConfigError(
                f"two policies are called '{policy.name}'; give one another name, e.g. '{policy.name}-2={policy.spec}'"
            )
        chosen[policy.name] = policy
    if not chosen:
        raise ConfigError("no policy is named; name one, e.g. 'random' or 'my_policy.py:MyPolicy'")
    return chosen


def _named(word: str) -> ChosenPolicy:
    """Find a policy by ``[NAME=]SPEC``."""
    found = re.fullmatch(rf"({NAME})=(.+)", word)
    return _chosen(found[1], found[2]) if found else _chosen("", word)


def _chosen(name: str, spec: str) -> ChosenPolicy:
    """Find a policy; without a name it has that of its class or of the registry."""
    name = name or Path(spec).name.rpartition(":")[2] or spec
    if len(name) > LONGEST_NAME:
        raise ConfigError(
            f"the policy's name '{name[:40]}...' has {len(name)} characters, at most {LONGEST_NAME} fit a folder; "
            "give it a shorter one: NAME=SPEC"
        )
    _require_path(spec.rpartition(":")[0], "the policy")
    make = _find(spec)
    if not re.fullmatch(NAME, name):
        raise ConfigError(
            f"'{name}' cannot name the folder of the policy '{spec}'; name it with letters, digits, - and _, e.g. "
            "'mine=file.py:MyPolicy'"
        )
    return ChosenPolicy(name=name, spec=spec, make=make)


def _require_path(text: str, what: str) -> None:
    """Refuse a text that is too long for a path."""
    if max(map(len, Path(text).parts), default=0) > LONGEST_FILE_NAME or "\0" in text:
        raise ConfigError(
            f"{what} '{text[:40]}...' is not a path: a file's name has at most {LONGEST_FILE_NAME} characters"
        )


def _find(spec: str) -> Callable[..., Policy] | None:
    if spec == EXPERT:
        return None
    if ":" not in spec and spec not in POLICIES:
        if spec.replace("-", "_") in REFUSED:
            raise ConfigError(f"policy '{spec}': {REFUSED[spec.replace('-', '_')]}")
        hint = f"; a class in a file is {spec}:CLASS" if spec.endswith(".py") else ""
        raise ConfigError(f"unknown policy '{spec}'; {one_of([*POLICIES, EXPERT], spec)}{hint}")
    return find_policy(spec)


def _options(names: Sequence[str], words: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the options by policy."""
    sorted_words: dict[str, list[str]] = {}
    for word in words:
        name, dot, _ = word.partition("=")[0].partition(".")
        if dot and name not in names:
            raise ConfigError(f"--option {word}: no policy '{name}'; {one_of(names, name)}")
        sorted_words.setdefault(name if dot else names[0], []).append(word[len(name) + 1 :] if dot else word)
    return {name: parse_options(given) for name, given in sorted_words.items()}


def _checkpoints(chosen: dict[str, ChosenPolicy], words: Sequence[str]) -> dict[str, str]:
    """Return the checkpoints by policy, as absolute paths."""
    found: dict[str, str] = {}
    shared: list[str] = []
    for word in words:
        name, equals, path = word.partition("=")
        _require_path(path or word, "the checkpoint")
        if not equals or Path(word).exists():
            shared.append(word)
        elif name not in chosen:
            raise ConfigError(f"--checkpoint {word}: no policy '{name}'; {one_of(chosen, name)}")
        elif name in found:
            raise ConfigError(f"--checkpoint gives '{name}' two, {found[name]} and {path}")
        else:
            found[name] = path
    if len(shared) > 1:
        raise ConfigError(
            f"--checkpoint {' and '.join(shared)}: say which policy each is for, e.g. --checkpoint "
            f"{next(iter(chosen))}={shared[0]}"
        )
    for path in shared:
        open_ones = [
            policy.name for policy in chosen.values()
            if policy.takes_checkpoint and policy.name not in found and CHECKPOINT not in policy.options
        ]  # fmt: skip
        if not open_ones:
            raise ConfigError(
                f"--checkpoint {path}: none of the policies takes it ({', '.join(chosen)}); leave it out, or name the "
                "policy that it is for with --checkpoint NAME=PATH"
            )
        kinds = Counter(chosen[name].spec for name in open_ones)
        if len(kinds) > 1:
            raise ConfigError(
                f"--checkpoint {path}: {' and '.join(open_ones)} take one; name the policy, e.g. --checkpoint "
                f"{open_ones[0]}={path}"
            )
        found |= dict.fromkeys(open_ones, path)
    for name, path in found.items():
        if not Path(path).exists():
            raise ConfigError(f"no checkpoint at {path}; give a file or a folder, e.g. what roboxim train bc wrote")
        if CHECKPOINT in chosen[name].options:
            raise ConfigError(f"policy '{name}' has a checkpoint by --option and by --checkpoint; give one of them")
    return {name: str(Path(path).resolve()) for name, path in found.items()}


def _checked(policy: ChosenPolicy) -> ChosenPolicy:
    """Return a valid policy; a trained one with its checkpoint's file, the same however the path to it is written."""
    _require_valid(policy)
    if policy.acting.spec not in FAMILIES:
        return policy
    file = checkpoint_file(Path(policy.options[CHECKPOINT])).resolve()
    return replace(policy, options={**policy.options, CHECKPOINT: str(file)})


def _require_valid(policy: ChosenPolicy) -> None:
    """Check a policy's options as far as possible without a network or a GPU."""
    if policy.make is None:
        if policy.options:
            raise ConfigError(f"the expert takes no options, got {', '.join(policy.options)}")
        return
    if policy.spec in FAMILIES and CHECKPOINT not in policy.options:
        raise ConfigError(
            f"policy '{policy.name}' needs a checkpoint, e.g. the folder that 'roboxim train {policy.spec}' wrote: "
            f"--checkpoint {policy.name}=PATH, or PolicySpec(spec='{policy.spec}', options={{'checkpoint': PATH}})"
        )
    if policy.own is None or not policy.own.is_instance:
        require_arguments(policy.spec, policy.make, policy.options)
    if policy.acting is not policy:
        _require_valid(policy.acting)
    elif policy.spec in FAMILIES:
        read_description(Path(policy.options[CHECKPOINT]))
    elif policy.make.__module__ == roboxim_policies.builtin.__name__:
        load_policy(policy.spec, **policy.options)  # quick, and names the wrong value
    elif policy.is_remote and policy.options.get("convention") != SERVERS_OWN:
        load_policy(policy.spec, **policy.options)  # does not connect
