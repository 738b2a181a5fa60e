"""Make the pictures of docs/how-to/studio.md and the film of the README, in a headless Chromium.

.venv/bin/python scripts/picture_studio.py docs/images
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

import roboxim
from roboxim_bringup.graph import start_graph
from roboxim_core.poses import Pose
from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain, register_run
from roboxim_studio.acting.live import LiveGraph
from roboxim_studio.app import DRIVE, GRAPH, SCENE, Studio
from roboxim_studio.editing import composition
from roboxim_studio.editing import document as edits
from roboxim_studio.opening import recognise

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/support"))
from browser import Browser, wait_for

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

    def extra(self, name: str, settle_s: float = 4.0) -> None:
        """Write a picture of the page that the film does not show; one of a phone at three quarters of its size."""
        image = self.shoot(settle_s)
        if image.height > image.width:
            image = image.resize((3 * image.width // 4, 3 * image.height // 4), Image.Resampling.LANCZOS)
        image.save(self._folder / f"{name}.webp", quality=75, method=6)

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
        composed(studio, browser, camera)
        scene(studio, browser, camera)
        episode(studio, browser, camera)
        studio.show(DRIVE)
        studio.drive.begin().result()
        browser.wait("document.documentElement.dataset.studioDriving === 'true'")
        browser.key("KeyF", down=True)
        camera.shoot(2.0)
        camera.picture("studio_drive")
        on_phone(studio, browser)
        browser.wait("document.documentElement.dataset.studioDriving === 'true'")
        camera.extra("studio_drive_phone")
        browser.key("KeyF", down=False)
        camera.film("studio")
    running_graph(folder)
    with tempfile.TemporaryDirectory() as work:
        run_and_dataset(folder, Path(work))
    print(f"written into {folder}")


def composed(studio: Studio, browser: Browser, camera: Photographer) -> None:
    """Show the form of a task, at the width of a desktop and of a phone."""
    studio.open_task("put_into").result()
    form = studio.compose.form
    form.edit(lambda made: composition.with_distractors(made, 1, 3))
    form.edit(lambda made: composition.with_templates(made, [*made.templates, "Hide the {target} in the {container}"]))
    studio.compose.draw(another=True).result()
    browser.wait("document.querySelector('#composed')?.innerText.includes('scene')")
    unfold(browser)
    camera.extra("studio_compose")
    on_phone(studio, browser)
    browser.wait("document.querySelector('#composed')?.innerText.includes('scene')")
    unfold(browser)
    camera.extra("studio_compose_phone")
    on_desktop(studio, browser)


def unfold(browser: Browser) -> None:
    """Open the form of a task, and bring it into sight."""
    browser.wait("document.querySelector('textarea')")
    browser.run("[...document.querySelectorAll('*')].findLast((one) => one.innerText?.trim() === 'Compose').click()")
    browser.run("document.querySelector('#composed').scrollIntoView()")


def on_phone(studio: Studio, browser: Browser) -> None:
    """Open the page at the size of a phone."""
    browser.resize(*PHONE, 2.0, phone=True)
    browser.open(studio.url)
    browser.wait("document.documentElement.dataset.studioConnected === 'true'")


def on_desktop(studio: Studio, browser: Browser) -> None:
    """Open the page at the size of a desktop."""
    browser.resize(*DESKTOP)
    browser.open(studio.url)
    browser.wait("document.documentElement.dataset.studioConnected === 'true'")


def running_graph(folder: Path) -> None:
    """Show a running graph."""
    with free_domain() as domain, NodeHost(domain_id=domain) as host, register_run("up", domain=domain) as run:
        start_graph(host)
        with Studio(graph=LiveGraph(run)) as studio, Browser(width=DESKTOP[0], height=DESKTOP[1]) as browser:
            studio.show(GRAPH)
            browser.open(studio.url)
            browser.wait("document.querySelector('#live-facts')?.innerText.includes('tick')")
            assert studio.live is not None
            studio.live.select("red_cube")
            camera = Photographer(browser, folder)
            camera.extra("studio_graph", 8.0)
            on_phone(studio, browser)
            browser.wait("document.querySelector('#live-facts')?.innerText.includes('tick')")
            camera.extra("studio_graph_phone", 8.0)


def run_and_dataset(folder: Path, work: Path) -> None:
    """Show a run that goes on, then its dataset, each at the width of a desktop and of a phone."""
    demos, dataset = work / "demos", work / "demos-lerobot"
    words = [str(Path(sys.executable).parent / "roboxim"), "generate", "--skill", "put_into", "--look", "varied"]
    with subprocess.Popen(
        [*words, "--episodes", "24", "--workers", "2", "--out", str(demos)], stdout=subprocess.DEVNULL
    ) as generating:
        wait_for(lambda: len(list(demos.glob("episodes/*"))) >= 3, "three finished episodes", 300)
        with Studio() as studio, Browser(width=DESKTOP[0], height=DESKTOP[1]) as browser:
            studio.open(recognise(str(demos)))
            browser.open(studio.url)
            camera = Photographer(browser, folder)
            browser.wait("document.body.innerText.includes('worker 0')")
            camera.extra("studio_run", 6.0)
            on_phone(studio, browser)
            browser.wait("document.body.innerText.includes('worker 0')")
            camera.extra("studio_run_phone", 6.0)
        generating.terminate()
    roboxim.export_lerobot(demos, dataset)
    with Studio() as studio, Browser(width=DESKTOP[0], height=DESKTOP[1]) as browser:
        studio.open(recognise(str(dataset)))
        browser.open(studio.url)
        browser.wait("document.querySelector('#dataset-arm')?.innerText.includes('in 3D')")
        studio.dataset.step(30)
        camera = Photographer(browser, folder)
        camera.extra("studio_dataset", 6.0)
        on_phone(studio, browser)
        browser.wait("document.querySelector('#dataset-arm')?.innerText.includes('in 3D')")
        camera.extra("studio_dataset_phone", 6.0)


def scene(studio: Studio, browser: Browser, camera: Photographer) -> None:
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
    on_phone(studio, browser)
    camera.extra("studio_scene_phone")
    on_desktop(studio, browser)
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
    on_phone(studio, browser)
    camera.extra("studio_what_if_phone", 6.0)
    on_desktop(studio, browser)


if __name__ == "__main__":
    main()
