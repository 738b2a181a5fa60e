"""The renderers, by name.

`raster` needs OpenGL (software GL is enough), `tiny` has no requirements, `photo` needs Blender (`make photo`).

The renderer is part of an episode's record, so there is no silent fallback to another one: requesting `raster` on a
machine without GL raises an error.
"""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from roboxim_core.registry import Registry
from roboxim_core.vision.renderer import Renderer

RENDERERS: Registry[Callable[[], Renderer]] = Registry("renderer")
"""Factories by renderer name; a plug-in registers its own under the entry point group ``roboxim.renderer``."""


@RENDERERS.conformance
def is_made_without_arguments(name: str, item: Callable[[], Renderer]) -> None:
    """Refuse a renderer that the sim cannot create; it is not created here, because that may need a GPU or Blender."""
    assert callable(item), "it is not callable"
    inspect.signature(item).bind()
    if isinstance(item, type):
        missing = [method for method in ("load", "render", "close") if not callable(getattr(item, method, None))]
        assert not missing, f"it has no {', '.join(missing)}; see roboxim_core.vision.renderer.Renderer"


@RENDERERS.register("raster")
def _raster() -> Renderer:
    from roboxim_sim.rendering.raster import RasterRenderer

    return RasterRenderer()


@RENDERERS.register("tiny")
def _tiny() -> Renderer:
    from roboxim_sim.rendering.tiny import TinyRenderer

    return TinyRenderer()


@RENDERERS.register("photo")
def _photo() -> Renderer:
    from roboxim_sim.rendering.photo import PhotoRenderer

    return PhotoRenderer()


def make_renderer(name: str) -> Renderer:
    """Create a renderer, bound to the calling thread.

    Args:
        name: A registered name, e.g. ``raster``.

    Raises:
        ConfigError: When no renderer has the name.
        SimError: RENDERER_UNAVAILABLE when it does not work on this machine; the message says what to install.
    """
    return RENDERERS[name]()


@dataclass(frozen=True, kw_only=True)
class RendererStatus:
    """Whether a renderer works on this machine."""

    available: bool
    """Whether the renderer can be created."""
    detail: str
    """The device that renders; for an unavailable renderer the reason and the remedy."""


def available_renderers(names: Iterable[str] | None = None) -> dict[str, RendererStatus]:
    """Test each renderer in a separate process, because a broken GL driver may crash or hang.

    Args:
        names: Renderers to test; none: all.
    """
    return {name: _probe(name) for name in (RENDERERS if names is None else names)}


PROBE_S = 300.0
"""Time limit for each renderer [s]."""
_PROBE = """
import sys
from roboxim_core.errors import RoboximError
from roboxim_sim.rendering import make_renderer
try:
    renderer = make_renderer(sys.argv[1])
except RoboximError as error:
    sys.exit(f"@@{error}")
sys.stdout.write(f"@@{renderer.device}")
renderer.close()
"""


def _probe(name: str) -> RendererStatus:
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, name], capture_output=True, text=True, timeout=PROBE_S, check=False
        )
    except subprocess.TimeoutExpired:
        return RendererStatus(available=False, detail=f"gave no answer within {PROBE_S:g} s")
    _, mark, detail = (done.stderr if done.returncode else done.stdout).rpartition("@@")
    if not mark:
        detail = f"died with exit status {done.returncode}: {done.stderr[-300:]}"
    return RendererStatus(available=done.returncode == 0, detail=detail.strip())
