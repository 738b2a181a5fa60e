"""Make the pictures of docs/how-to/studio.md and the film of the README, in a headless Chromium.

.venv/bin/python scripts/picture_studio.py docs/images
"""

from __future__ import annotations

import argparse
import io
import tempfile
from pathlib import Path

from PIL import Image

from roboxim_core.poses import Pose
from roboxim_studio.app import DRIVE, SCENE, Studio
from roboxim_studio.browser import Browser
from roboxim_studio.editing import document as edits

DESKTOP, PHONE = (1440, 900), (390, 844)
FILM_WIDTH = 960
QUIET = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(one => one.click())"
"""Closes the page's note that WebGL is software here."""


class Photographer:
    """Takes pictures of a page, and collects those of the film."""

    def __init__(self, browser: Browser, folder: Path) -> None:
        """Take pictures into a folder."""
        self._browser, self._folder = browser, folder
        self._frames: list[tuple[Image.Image, int]] = []

    def shoot(self, settle_s: float = 2.5) -> Image.Image:
        """Return the page when it has settled."""
        self._browser.run(QUIET)
        self._browser.run(f"new Promise(done => setTimeout(done, {1000 * settle_s:.0f}))")
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "page.png"
            self._browser.screenshot(file)
            return Image.open(io.BytesIO(file.read_bytes())).convert("RGB")

    def picture(self, name: str, *, film_ms: int = 2500) -> None:
        """Write a picture of the page, and show it in the film for a while."""
        image = self.shoot()
        image.save(self._folder / f"{name}.webp", quality=82, method=6)
        self.frame(image, film_ms)

    def frame(self, image: Image.Image, film_ms: int) -> None:
        """Add a picture to the film."""
        height = round(FILM_WIDTH * image.height / image.width)
        self._frames.append((image.resize((FILM_WIDTH, height), Image.Resampling.LANCZOS), film_ms))

    def film(self, name: str) -> None:
        """Write the film."""
        first, *others = [image for image, _ in self._frames]
        first.save(
            self._folder / f"{name}.webp", save_all=True, append_images=others, quality=70, method=6, loop=0,
            duration=[film_ms for _, film_ms in self._frames],
        )  # fmt: skip


def main() -> None:
    """Make them all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where to write")
    folder = parser.parse_args().folder
    with (
        tempfile.TemporaryDirectory() as work,
        Studio(folder=Path(work)) as studio,
        Browser(width=DESKTOP[0], height=DESKTOP[1]) as browser,
    ):
        browser.open(studio.url)
        browser.wait("document.documentElement.dataset.studioConnected === 'true'")
        camera = Photographer(browser, folder)
        scene(studio, camera)
        episode(studio, browser, camera)
        studio.show(DRIVE)
        studio.drive.begin().result()
        browser.wait("document.documentElement.dataset.studioDriving === 'true'")
        browser.key("KeyF", down=True)
        camera.shoot(2.0)
        camera.picture("studio_drive")
        browser.key("KeyF", down=False)
        camera.film("studio")
    print(f"written into {folder}")


def scene(studio: Studio, camera: Photographer) -> None:
    """Show a scene that is drawn, made invalid, mended, and solved."""
    studio.open_task("pick_cube_distractors").result()
    desk = studio.editor.desk
    assert desk is not None
    desk.refresh().result()
    studio.editor.select("target")
    camera.picture("studio_scene")
    x, y, z = desk.scene.entity("target").pose.position
    studio.editor.edit(lambda document: edits.moved(document, "distractor_1", Pose(position=(x, y + 0.02, z))))
    desk.refresh().result()
    studio.editor.select("distractor_1")
    camera.picture("studio_refused")
    desk.undo()
    desk.refresh().result()
    studio.show(SCENE)
    studio.compose.solve().result()


def episode(studio: Studio, browser: Browser, camera: Photographer) -> None:
    """Show an episode that is scrubbed and handed over, at the width of a desktop and of a phone."""
    film = studio.episode.film
    assert film is not None
    for seq in range(0, len(film), 6):
        studio.episode.show(seq)
        camera.frame(camera.shoot(1.0), 250)
    studio.episode.show(round(0.75 * film.result.steps))
    camera.picture("studio_episode")
    browser.resize(*PHONE, 2.0, phone=True)
    browser.open(studio.url)
    browser.wait("document.querySelector('#tick-facts')")
    image = camera.shoot(4.0)
    image.save(Path(camera._folder) / "studio_phone.webp", quality=82, method=6)
    browser.resize(*DESKTOP)
    browser.open(studio.url)
    browser.wait("document.querySelector('#tick-facts')")
    studio.episode.show(12)
    studio.what_if._moved.value = "target"
    studio.what_if._by.value = (0.0, -0.12)
    studio.what_if.start().result()
    studio.episode.show(film.result.steps)
    for client in studio.site.viser.get_clients().values():
        client.camera.position, client.camera.look_at = (2.4, -0.85, 1.3), (0.4, -0.8, 0.1)
    camera.picture("studio_what_if")


if __name__ == "__main__":
    main()
