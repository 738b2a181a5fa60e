"""The studio: from command to page to first picture, state updates, memory of many episodes, cost of watching a run.

Needs an installed Chromium, whose WebGL is software here; a page with a GPU draws sooner. A run is generated alone and
watched in turns; the page that watches has been opened and drawn before the run begins.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from hashlib import sha256
from pathlib import Path
from statistics import median
from urllib.request import urlopen

from benchmarks._harness import Bench, rss_mib

from roboxim_studio.app import Studio

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests/support"))
from browser import Browser, wait_for

ROBOXIM = (sys.executable, "-m", "roboxim_cli")
COUNT = (
    "(() => { window.seen = 0; new MutationObserver(() => window.seen++).observe(document.body, "
    "{subtree: true, characterData: true, childList: true}) })()"
)
OPENED_S = 5.0
"""Time for a page to finish its first pictures before the run that it watches begins [s]."""
BODIES = 30
"""Draw calls of a frame from which on the whole scene is in it; frames before have the floor, or nothing."""
FRAMES = """
(() => {
  let calls = 0, gl = null;
  for (const name of ['drawElements', 'drawArrays', 'drawElementsInstanced']) {
    const genuine = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) {
      calls++;
      gl = this;
      return genuine.apply(this, given);
    };
  }
  const next = window.requestAnimationFrame;
  window.requestAnimationFrame = (draw) => next.call(window, (time) => {
    calls = 0;
    draw(time);
    if (calls < BODIES || window.firstFrame) return;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));  // waits until it is drawn
    window.firstFrame = performance.now() / 1000;
  });
})()
""".replace("BODIES", str(BODIES))
"""Notes the time from opening the page to the end of the first frame that shows the scene [s]."""
DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


def main() -> None:
    """Measure and print."""
    bench = Bench("studio", __doc__)
    episodes, turns, opened = (6, 1, 50) if bench.quick else (24, 7, 1000)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        alone, watched = [], []
        generate(folder / "warm", 2)
        for turn in range(turns):
            alone.append(generate(folder / f"alone{turn}", episodes))
            watched.append(generate_watched(folder / f"watched{turn}", episodes))
        assert contents(folder / "alone0") == contents(folder / "watched0"), "watching has changed a bag"
        bag = next((folder / "alone0" / "episodes").iterdir())
        start_up(bench, bag)
        per_second = updates(bench, bag)
        memory(bench, bag, opened)
    for turn, pair in enumerate(zip(alone, watched, strict=True)):
        cost = 100 * (pair[1] / pair[0] - 1)
        bench.row(what=f"generate {episodes}, turn {turn}", alone_s=round(pair[0], 1), watched_s=round(pair[1], 1),
                  cost_percent=round(cost, 1))  # fmt: skip
    cost = 100 * (median(pair[1] / pair[0] for pair in zip(alone, watched, strict=True)) - 1)
    bench.row(what="generate, median of the turns", cost_percent=round(cost, 1))
    bench.finish("state updates per second with pictures and conditions", per_second, "/s", at_least=20)


def contents(run: Path) -> dict[str, str]:
    """Return the hash of every bag of a run, by name."""
    return {file.name: sha256(file.read_bytes()).hexdigest() for file in run.glob("episodes/*/*.mcap")}


def generate(out: Path, episodes: int) -> float:
    """Generate demonstrations; returns the time [s]."""
    began = time.monotonic()
    subprocess.run(
        [*ROBOXIM, "generate", "--task", "pick_cube", "--episodes", str(episodes), "--size", "128", "--out", str(out)],
        check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    return time.monotonic() - began


def generate_watched(out: Path, episodes: int) -> float:
    """Generate demonstrations while a page follows their folder; returns the time [s]."""
    with Studio(folder=out.parent) as studio, Browser(width=900, height=600) as browser:
        studio.files.open(out, ())
        browser.open(studio.url)
        browser.wait("document.documentElement.dataset.studioConnected === 'true'")
        browser.run(DRAWN)
        time.sleep(OPENED_S)
        took = generate(out, episodes)
        wait_for(lambda: len(studio.files.entries) == episodes, "the page to list the whole run")
    return took


def start_up(bench: Bench, bag: Path) -> None:
    """Add the times from the command to the page, and from opening the page to its first picture."""
    began = time.monotonic()
    process = subprocess.Popen([*ROBOXIM, "studio", str(bag), "--no-browser"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        found = re.search(r"http://\S+", process.stdout.readline())
        assert found, "the command printed no address"
        urlopen(found[0]).read()
        page_s = time.monotonic() - began
        bench.row(what="command to page", s=round(page_s, 2))
        with Browser(width=900, height=600) as browser:
            browser.before_pages(FRAMES)
            began = time.monotonic()
            browser.open(found[0])
            browser.wait("document.querySelector('#tick-facts')")
            bench.row(what="page to panel", s=round(time.monotonic() - began, 2))
            browser.run(DRAWN)
            bench.row(what="page to two frames after the panel", s=round(time.monotonic() - began, 2))
            browser.wait("window.firstFrame")
            drawn_s = float(browser.run("window.firstFrame"))
            bench.row(what="page to first picture of the scene", s=round(drawn_s, 2))
            bench.row(what="command to first picture, without the browser's start", s=round(page_s + drawn_s, 2))
    finally:
        process.terminate()
        process.wait()


def updates(bench: Bench, bag: Path) -> float:
    """Add and return the rate of state updates with one page; the page shows what its browser has time for."""
    with Studio() as studio, Browser(width=900, height=600) as browser:
        film = studio.open_bag(bag)
        film.pictures.complete.wait()
        browser.open(studio.url)
        browser.wait("document.querySelector('#tick-facts')")
        browser.run(COUNT)
        began, number = time.monotonic(), 0
        while time.monotonic() - began < 5.0:
            studio.episode.show(number % len(film))
            number += 1
        rate = number / (time.monotonic() - began)
        seen = int(browser.run("window.seen")) / (time.monotonic() - began)
    bench.row(what="state updates", per_s=round(rate, 1), page_redraws_per_s=round(seen, 1))
    return rate


def memory(bench: Bench, bag: Path, opened: int) -> None:
    """Add the memory before and after many episodes."""
    with Studio() as studio:
        for _ in range(20):
            studio.open_bag(bag).pictures.complete.wait()
        before = rss_mib()
        for _ in range(opened):
            studio.open_bag(bag).pictures.complete.wait()
        bench.row(what=f"{opened} episodes opened", before_mib=round(before), after_mib=round(rss_mib()))


if __name__ == "__main__":
    main()
