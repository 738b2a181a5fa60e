"""An episode, or a scene, as one HTML file that plays without a server and without a network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from roboxim_core.config import digest
from roboxim_core.models.library import ModelLibrary
from roboxim_core.state import StateRecord
from roboxim_core.whole_files import write_whole
from roboxim_studio.episode.film import Film, ending, marks
from roboxim_studio.look.scene_view import SceneView
from roboxim_studio.panels import markup
from roboxim_studio.serving.access import Access
from roboxim_studio.serving.site import Site
from roboxim_tasks.fixed_scene import FixedTask

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' data: blob:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; worker-src data: blob:; connect-src data: blob:"
)
"""Content security policy of the file: a browser refuses every request that it could make."""
NOTE_STYLE = (
    "position:fixed;left:8px;top:8px;max-width:min(44ch,calc(100vw - 16px));padding:6px 4px;border-radius:6px;"
    "background:rgba(255,255,255,.88);color:#212529;font:13px/1.4 system-ui,sans-serif;z-index:10;"
    "box-sizing:border-box;pointer-events:none"
)


def episode_html(film: Film, library: ModelLibrary) -> str:
    """Return an episode as one HTML file: the scene in 3D with a seek bar, its cameras, verdict, facts and moments.

    Args:
        film: The episode; waits for its pictures.
        library: Robots and objects.

    Raises:
        RoboximError: When its models are unknown.
    """
    film.pictures.requested.set()
    film.pictures.complete.wait()
    site = Site(Access())
    try:
        server = site.viser
        server.scene.set_up_direction("+z")
        server.initial_camera.position, server.initial_camera.look_at = (1.55, -0.9, 0.95), (0.45, 0.0, 0.1)
        view = SceneView(server, library)
        view.load(film.info.scene)
        label = server.scene.add_label("/tick", "")
        label.position = (0.0, 0.0, 1.0)
        recording = server.get_scene_serializer()
        for state, step in zip(film.states, film.steps, strict=True):
            view.show(state, film.pictures.at(state.seq))
            verdict = step.verdict
            outcome = "solved" if verdict.success else f"failed: {verdict.reason}" if verdict.failed else verdict.reason
            label.text = f"tick {state.seq}: {outcome}"
            recording.insert_sleep(film.info.scene.tick_ns / 1e9)
        page = recording.as_html()
    finally:
        site.close()
    return _finished(page, film)


def share(film: Film, library: ModelLibrary, file: Path) -> Path:
    """Write an episode as one HTML file; returns it.

    Raises:
        RoboximError: When its models are unknown.
        OSError: When it cannot be written.
    """
    write_whole(file, episode_html(film, library))
    return file


def share_scene(document: FixedTask, state: StateRecord, library: ModelLibrary, file: Path) -> Path:
    """Write a task's scene at its start as one HTML file; returns it.

    Raises:
        RoboximError: When its models are unknown.
        OSError: When it cannot be written.
    """
    site, scene = Site(Access()), document.fixed.scene
    try:
        view = SceneView(site.viser, library)
        recording = site.viser.get_scene_serializer()
        view.load(scene)
        view.show(state)
        recording.insert_sleep(0.1)
        page = recording.as_html()
    finally:
        site.close()
    rows = [("instruction", document.fixed.instruction), ("skill", document.skill), ("scene", digest(scene))]
    write_whole(file, _with_note(page, document.fixed.instruction, rows))
    return file


def _finished(page: str, film: Film) -> str:
    """Return the page with its policy, its title, and what a person should know of the episode."""
    info = film.info
    rows: list[tuple[str, object]] = [
        ("instruction", info.task.instruction), ("actor", info.actor), ("outcome", ending(film)),
        ("episode", info.episode_id), ("scene", film.states[0].scene_hash),
        ("moments", ", ".join(f"{mark.seq} {mark.name}" for mark in marks(film))),
    ]  # fmt: skip
    return _with_note(page, f"{info.task.instruction} - {ending(film)}", rows)


def _with_note(page: str, words: str, rows: Sequence[tuple[str, object]]) -> str:
    """Return a page with its policy, a title, and a table of facts."""
    facts, title = markup.facts(rows), markup.escaped(words)
    policy = f'<head><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    note = f'<div id="episode" style="{NOTE_STYLE}">{facts}</div></body>'
    page = page.replace("<head>", policy, 1).replace("<title>Viser</title>", f"<title>{title}</title>", 1)
    before, _, after = page.rpartition("</body>")
    return before + note + after
