"""The base class of policies, and the lookup of policies by name.

A policy is one class with one ``act`` method::

    class MyPolicy(BasePolicy):
        cameras = ("workspace", "wrist")

        def act(self, window):
            image = window.newest.images["wrist"]
            return [0.0, 0.0, -0.01, 0.0, 0.0, 0.0, 1.0]
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, Self

import numpy.typing as npt

from roboxim_core.actions import ActionSemantics, Chunking, GripperRule, check_chunk
from roboxim_core.config import from_plain
from roboxim_core.errors import ConfigError, PolicyError, RoboximError, UnavailableError, nearest, one_of
from roboxim_core.plain_data.extras import not_installed
from roboxim_core.policies import (
    ActionChunk,
    CameraRequirement,
    EpisodeStart,
    ObservationWindow,
    Policy,
    PolicyDescription,
)
from roboxim_core.registry import Registry, run_file

POLICIES: Registry[Callable[..., Policy]] = Registry("policy")
"""Policies by name: classes or factories. Entry point group of plug-ins: ``roboxim.policy``."""


@POLICIES.conformance
def takes_typed_arguments(name: str, item: Callable[..., Policy]) -> None:
    """Refuse a policy that is not a class with the three methods, or whose arguments lack type annotations.

    A policy is not made: most need a checkpoint, which the contract does not have.
    """
    assert callable(item), "it is not callable"
    signature = inspect.signature(item, eval_str=True)
    for parameter in signature.parameters.values():
        assert parameter.annotation is not parameter.empty, f"argument '{parameter.name}' has no type"
    kind = item if isinstance(item, type) else signature.return_annotation
    missing = [method for method in ("describe", "reset", "act") if not callable(getattr(kind, method, None))]
    assert not missing, f"it has no method {', '.join(missing)}; derive it from BasePolicy"
    assert not inspect.isabstract(kind) or not isinstance(item, type), "it is abstract: write its act method"


@POLICIES.conformance
def answers_with_actions(name: str, item: Callable[..., Policy]) -> None:
    """Refuse actions that a graph would refuse, or that a seed does not reproduce; of policies without arguments."""
    required = [p for p in inspect.signature(item).parameters.values() if p.default is p.empty and p.kind not in (2, 4)]
    if required:
        return
    try:
        policy = item()
    except ConfigError:  # it needs one of several arguments, e.g. a source or actions
        return
    description = policy.describe()
    if description.cameras:
        return
    window = ObservationWindow(instruction="", observations=[], pad_mask=(), episode_id="check", seq=0)
    chunks = []
    for _ in range(2):
        policy.reset(EpisodeStart(episode_id="check", instruction="", seed=1))
        answer = policy.act(window)
        actions = answer.actions if isinstance(answer, ActionChunk) else answer
        chunks.append(check_chunk(actions, max_rows=description.horizon))
    assert chunks[0].tobytes() == chunks[1].tobytes(), "two episodes of one seed begin with different actions"


class BasePolicy(ABC):
    """Base class of policies; subclasses must implement only `act`.

    Class attributes declare what the policy requires. A policy whose requirements depend on its arguments sets them in
    its constructor.
    """

    name: str = ""
    """Name for reports; empty: the class's name."""
    cameras: Sequence[str | CameraRequirement] = ()
    """Cameras whose images the policy needs: names, or `CameraRequirement` with a size in pixels."""
    window: int = 1
    """Number of observations per request, newest last."""
    horizon: int = 1
    """Largest number of actions that `act` returns."""
    semantics: ActionSemantics = ActionSemantics()
    """Meaning of the actions; the episode loop converts them to what the simulator executes."""
    privileged: bool = False
    """Whether the policy reads the task, the scene and the state record. A policy under test must not."""
    version: str = ""
    """Version or checkpoint, for reports and bags."""
    chunking: Chunking = Chunking()
    """How chunks are executed, unless the run says otherwise: actions per request, ensemble, late answers."""
    gripper: GripperRule = GripperRule()
    """When the gripper opens and closes, unless the run says otherwise."""
    lag: tuple[float, ...] = ()
    """Lag of the arm that the policy was trained with, see `PolicyDescription.lag`; empty: none."""
    any_thread: bool = False
    """Whether any thread may call `act`, and `act` waits for nothing outside this process. Then an evaluator of the
    same process calls the policy directly in its own thread, which saves two thread switches; it cannot give up an
    answer."""

    def describe(self) -> PolicyDescription:
        """Return the policy's description, built from the attributes.

        Raises:
            InvalidRequestError: On a window or horizon below 1.
        """
        cameras = (self.cameras,) if isinstance(self.cameras, str) else self.cameras
        return PolicyDescription(
            name=self.name or type(self).__name__,
            semantics=self.semantics,
            cameras=tuple(CameraRequirement(name=c) if isinstance(c, str) else c for c in cameras),
            window=self.window,
            horizon=self.horizon,
            privileged=self.privileged,
            version=self.version,
            chunking=self.chunking,
            gripper=self.gripper,
            lag=self.lag,
        )

    def reset(self, start: EpisodeStart) -> None:  # noqa: B027 - most policies have nothing to forget
        """Start an episode: forget the previous one.

        Args:
            start: Episode id, instruction and a seed for the policy's own randomness.
        """

    @abstractmethod
    def act(self, window: ObservationWindow) -> npt.ArrayLike | ActionChunk:
        """Return the next actions.

        Args:
            window: Instruction and the last observations: RGB images by camera (uint8, (height, width, 3), read-only)
                and ``proprio`` (`roboxim_core.proprioception.Proprioception`; ``proprio.vector()`` is one array).

        Returns:
            Array-like of shape (horizon, D) or (D,), by default with D = 7: translation [m], rotation [rad], gripper
            (1 = open); see `ActionSemantics`. Fewer rows than ``horizon`` are allowed.
        """

    def another(self) -> Policy | None:
        """Return a policy that shares this one's model but keeps its own episode; none: it cannot share it.

        A process that serves the policy to several simulators (``--policy-servers``) needs one for each of them, and
        makes them from scratch otherwise.
        """
        return None

    @classmethod
    def act_batch(cls, policies: Sequence[Self], windows: Sequence[ObservationWindow]) -> Sequence[Any]:
        """Return the next actions of several episodes. A policy that computes them together overrides this.

        Only a process that serves the policy to several simulators calls it (``--policy-servers``). When it raises, it
        is called again for each episode alone, so change no episode's state before the answers are computed.

        Args:
            policies: One for each episode: the policy itself, or what `another` returned.
            windows: The request of each; see `act`.

        Returns:
            What `act` returns, for each.
        """
        return [policy.act(window) for policy, window in zip(policies, windows, strict=True)]


def load_policy(spec: str, **kwargs: Any) -> Policy:
    """Load and instantiate a policy.

    Args:
        spec: A registered name (``random``), ``module:Class``, or ``path/to/file.py:Class``; the working directory is
            importable.
        **kwargs: Passed to the class.

    Raises:
        ConfigError: When there is no such policy, or it does not take these arguments; the message lists the valid
            ones.
        PolicyError: When its module or its constructor raises; the message says where.
    """
    make = find_policy(spec)
    require_arguments(spec, make, kwargs)
    with blaming(f"policy '{spec}' cannot be made"):
        policy = make(**kwargs)
    missing = [name for name in ("describe", "reset", "act") if not callable(getattr(policy, name, None))]
    if missing:
        raise ConfigError(
            f"policy '{spec}' has no method {', '.join(missing)}; derive it from roboxim_policies.BasePolicy"
        )
    return policy


def find_policy(spec: str) -> Callable[..., Policy]:
    """Return the class or factory of a policy without calling it. Imports its module or file, if one is named.

    Args:
        spec: See `load_policy`.

    Raises:
        ConfigError: When there is no such policy; the message lists the known ones.
        PolicyError: When its module raises; the message says where.
    """
    # The shipped policies register themselves on import.
    return _load_class(spec) if ":" in spec else POLICIES[spec]


def require_arguments(spec: str, make: Callable[..., Policy], arguments: Mapping[str, Any]) -> None:
    """Refuse missing arguments, arguments that a policy does not take, and values of a wrong type.

    Raises:
        ConfigError: The message names each wrong and missing argument, and lists the policy's arguments.
    """
    kinds = inspect.signature(make, eval_str=True).parameters
    named = {name: kind for name, kind in kinds.items() if kind.kind not in (kind.VAR_POSITIONAL, kind.VAR_KEYWORD)}
    takes_any = any(kind.kind == kind.VAR_KEYWORD for kind in kinds.values())
    found = []
    for name in () if takes_any else [name for name in arguments if name not in named]:
        hint = nearest(named, name)
        found.append(f"'{name}' is unknown" + (f" ({hint})" if hint else ""))
    about = _argument_texts(make)
    for name, kind in named.items():
        if kind.default is kind.empty and name not in arguments:
            found.append(f"'{name}' is missing" + (f" ({about[name]})" if name in about else ""))
    if found:
        takes = [name if kind.default is kind.empty else f"{name}={kind.default!r}" for name, kind in named.items()]
        raise ConfigError(
            f"policy '{spec}' does not take these arguments: {'; '.join(found)}. "
            f"It takes {', '.join(takes) or 'none'}; pass them with --option NAME=VALUE"
        )
    for name, value in arguments.items():
        if name in kinds and kinds[name].annotation in (bool, int, float, str):
            from_plain(value, kinds[name].annotation, source=f"argument '{name}' of policy '{spec}'")


def _argument_texts(make: Callable[..., Any]) -> dict[str, str]:
    """Return what the docstring of a class or factory says of its arguments, by name, without the final full stop."""
    described: Any = make
    doc = inspect.getdoc(described.__init__ if isinstance(make, type) else make) or ""
    listed = doc.partition("Args:\n")[2].partition("\n\n")[0]
    entries = re.findall(r"^    (\w+): (.*(?:\n {8,}.*)*)", listed, re.MULTILINE)
    return {name: " ".join(text.split()).replace("``", "").rstrip(".") for name, text in entries}


def _load_class(spec: str) -> Callable[..., Policy]:
    where, _, name = spec.rpartition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    module = _import_file(Path(where)) if where.endswith(".py") else _import_module(where)
    found: Callable[..., Policy] | None = getattr(module, name, None)
    if not callable(found):
        classes = [key for key, value in vars(module).items() if isinstance(value, type) and hasattr(value, "act")]
        known = one_of(classes, name) if classes else "it has no class with a method act"
        raise ConfigError(f"no policy class '{name}' in '{where}'; {known}")
    if isinstance(found, type) and inspect.isabstract(found):
        raise ConfigError(f"policy '{spec}' is abstract: implement its act method")
    return found


def _import_module(name: str) -> ModuleType:
    with blaming(f"policy module '{name}' cannot be imported"):
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise
            raise ConfigError(
                f"no module '{name}'; give a module on the path or in {os.getcwd()}, or a path/to/file.py:Class"
            ) from None


def _import_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise ConfigError(f"no such file: {path}")
    with blaming(f"policy file {path} cannot be imported"):
        return run_file(path, path.stem)


@contextmanager
def blaming(what: str) -> Iterator[None]:
    """Convert exceptions of a user's code, including ``SystemExit``, to errors that say where they were raised."""
    try:
        yield
    except RoboximError:
        raise
    except ModuleNotFoundError as error:
        raise UnavailableError(f"{what}: it needs {not_installed(error.name or '')}") from error
    except (Exception, SystemExit) as error:
        *_, last = traceback.extract_tb(error.__traceback__)
        where = "" if isinstance(error, SyntaxError) else f" (raised at {last.filename}:{last.lineno})"
        raise PolicyError(f"{what}: {type(error).__name__}: {str(error) or 'no message'}{where}") from error
