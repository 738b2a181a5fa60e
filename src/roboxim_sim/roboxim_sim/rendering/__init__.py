"""The renderers, by name.

`raster` needs OpenGL (software GL will do), `tiny` needs nothing, `photo` needs Blender (`make photo`).

A renderer is part of an episode's record, so one is never taken in place of another silently: asking for `raster`
where there is no GL raises an error.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from roboxim_core.registry import Registry
from roboxim_core.rendering import Renderer

RENDERERS: Registry[Callable[[], Renderer]] = Registry("renderer")
"""Name to a factory; a plug-in registers its own under the entry point group ``roboxim.renderer``."""


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
    """Make a renderer, bound to the calling thread.

    Args:
        name: A registered name, e.g. ``raster``.

    Raises:
        ConfigError: When no renderer has the name.
        SimError: RENDERER_UNAVAILABLE when it does not work on this machine; the message says what to install.
    """
    return RENDERERS[name]()


@dataclass(frozen=True, kw_only=True)
class RendererStatus:
    """Whether a renderer works here."""

    available: bool
    """Whether it can be made."""
    detail: str
    """What draws, or why it cannot and what to do."""


def available_renderers(names: Iterable[str] | None = None, timeout_s: float = 300.0) -> dict[str, RendererStatus]:
    """Try every renderer in a process of its own, because a broken GL driver may crash or hang.

    Args:
        names: Renderers to try; none: all.
        timeout_s: Longest time for one renderer [s].
    """
    return {name: _probe(name, timeout_s) for name in (RENDERERS if names is None else names)}


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


def _probe(name: str, timeout_s: float) -> RendererStatus:
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, name], capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        return RendererStatus(available=False, detail=f"gave no answer within {timeout_s:g} s")
    _, mark, detail = (done.stderr if done.returncode else done.stdout).rpartition("@@")
    if not mark:
        detail = f"died with exit status {done.returncode}: {done.stderr[-300:]}"
    return RendererStatus(available=done.returncode == 0, detail=detail.strip())
