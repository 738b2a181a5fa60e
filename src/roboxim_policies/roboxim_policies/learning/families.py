"""The families of trained policies: for each, its configuration and the network that it describes.

A family is a folder with ``config.py`` (a `LearningConfig`, without JAX) and ``network.py`` (``make_network``). They
are imported when they are needed.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from roboxim_core.errors import ConfigError, one_of
from roboxim_policies.learning.config import LearningConfig

FAMILIES = {"bc": "BCConfig", "rt1s": "RT1SConfig", "act": "ACTConfig"}
"""Family to the class of its configuration, in ``roboxim_policies.FAMILY.config``."""


def config_class(family: str) -> type[LearningConfig]:
    """Return the class of a family's configuration.

    Raises:
        ConfigError: When there is no such family.
    """
    if family not in FAMILIES:
        raise ConfigError(f"unknown family of policies '{family}'; {one_of(FAMILIES, family)}")
    found: type[LearningConfig] = getattr(import_module(f"roboxim_policies.{family}.config"), FAMILIES[family])
    return found


def make_network(config: LearningConfig, cameras: tuple[str, ...], vocabulary: int, seed: int) -> Any:
    """Draw a network's weights; imports JAX.

    Args:
        config: Configuration of any family.
        cameras: Names of the cameras.
        vocabulary: Number of words in the training's instructions.
        seed: Seed of the weights.

    Returns:
        The weights as one vector, so that an optimiser step is a single operation, and a function that makes a network
        (`roboxim_policies.learning.layers.Network`) from such a vector.
    """
    make: Callable[..., Any] = import_module(f"roboxim_policies.{config.FAMILY}.network").make_network
    return make(config, cameras, vocabulary, seed)
