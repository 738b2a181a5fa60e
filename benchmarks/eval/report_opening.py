"""Size of reports of 2,000 episodes, and the time in which a browser opens them.

The pages are an evaluation of two policies and an experiment (`skill_object`, 5 trainings), with simulated outcomes,
twelve recorded factors and films of noise, which compress worse than any real one. Chromium opens each without a
window, from a server in this process. The time is that from the start of the navigation to the second frame after the
page was loaded.
`--report FILE` measures a page of your own too.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Empty, Queue
from statistics import median
from threading import Thread

import numpy as np
from benchmarks._harness import Bench
from planted_cards import planted_card, shipped

from roboxim_core.episode import EpisodeResult
from roboxim_eval.experiments.card import Card
from roboxim_eval.experiments.cost import FILMS
from roboxim_eval.report.episodes import Episode
from roboxim_eval.report.evaluation import PolicyRun, Report, write_report
from roboxim_eval.report.experiment import ExperimentPage, experiment_page
from roboxim_eval.report.films import Film, film_strip

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
OPENED = """<script>addEventListener("load", () => requestAnimationFrame(() => requestAnimationFrame(() =>
fetch("/opened", {method: "POST", body: performance.now()}))));</script>"""
"""What the page under test sends after its second frame."""
LIMIT_S = 60.0
FRAMES = (24, 128, 256, 3)


def main() -> None:
    """Write the pages and open them."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--report", type=Path, action="append", default=[], help="a page of your own")

    bench = Bench("report_opening", __doc__, options)
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        sys.exit(f"no browser of {', '.join(BROWSERS)}: install Debian's package chromium")
    with tempfile.TemporaryDirectory(prefix="roboxim-reports-") as name:
        folder = Path(name)
        pages = {"evaluation": _evaluation(folder), "experiment": _experiment(folder)}
        pages |= {str(file): file for file in bench.options.report}
        slowest = 0.0
        for kind, page in pages.items():
            times = [_opening_s(browser, page, folder) for _ in range(3 if bench.quick else 7)]
            slowest = max(slowest, median(times))
            size = round(page.stat().st_size / 1e6, 2)
            bench.row(report=kind, megabytes=size, median_s=round(median(times), 2), longest_s=round(max(times), 2))
    bench.finish("opening a report of 2,000 episodes, the slower of its kinds", slowest, "s", at_most=2.0)


def _opening_s(browser: str, page: Path, folder: Path) -> float:
    """Return the time to open a page [s], as the page itself tells it."""
    content = page.read_text().replace("</head>", OPENED + "</head>", 1).encode()
    told: Queue[float] = Queue()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._answer(content if self.path == "/" else b"")

        def do_POST(self) -> None:
            told.put(float(self.rfile.read(int(self.headers["Content-Length"]))))
            self._answer(b"")

        def _answer(self, body: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            with contextlib.suppress(ConnectionError):  # the browser was ended
                self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}",
                   f"http://127.0.0.1:{server.server_port}/"]  # fmt: skip
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            return told.get(timeout=LIMIT_S) / 1000
        except Empty:
            sys.exit(f"{page} was not open after {LIMIT_S:g} s")
        finally:
            process.terminate()
            process.wait()
            server.shutdown()


def _noise(rng: np.random.Generator) -> Film:
    return film_strip(list(rng.integers(0, 255, FRAMES, np.uint8)))


def _drawn(rng: np.random.Generator) -> dict[str, str]:
    return {f"factor {number}": f"{rng.random():.4f}" for number in range(12)}


def _start(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(0.3, 0.6)), float(rng.uniform(-0.2, 0.2))


def _evaluation(folder: Path) -> Path:
    rng = np.random.default_rng(0)
    runs = []
    for policy in ("bc", "octo"):
        results = [_result(rng, number) for number in range(1000)]
        names = [result.episode_id for result in results]
        runs.append(PolicyRun(
            policy=policy, results=results, folder=policy, films={name: _noise(rng) for name in names[: FILMS // 2]},
            drawn={name: _drawn(rng) for name in names}, starts={name: _start(rng) for name in names},
        ))  # fmt: skip
    report = Report(title="bc and octo", runs=runs, facts={}, versions={}, command="roboxim evaluate")
    return write_report(report, folder)


def _result(rng: np.random.Generator, number: int) -> EpisodeResult:
    success = rng.random() < 0.6
    return EpisodeResult(
        episode_id=f"evaluation-0-{number:05d}-0", index=number, outcome="success" if success else "failure",
        reason="" if success else "not_lifted", instruction="Pick up the red cube", steps=40,
        bag=f"episodes/{number}",
    )  # fmt: skip


def _experiment(folder: Path) -> Path:
    card = planted_card(shipped(replicates=5, per_cell=10), lambda condition, cell: 0.4 if cell.unseen else 0.8)
    rng = np.random.default_rng(0)
    episodes = list(_episodes(card, rng))
    films = {int(number): _noise(rng) for number in rng.choice(len(episodes), FILMS, replace=False)}
    page = folder / "experiment.html"
    page.write_text(experiment_page(ExperimentPage(card=card, episodes=episodes, films=films, command="roboxim")))
    return page


def _episodes(card: Card, rng: np.random.Generator) -> Iterator[Episode]:
    for evaluation in card.evaluations:
        for cell, (successes, count, _) in evaluation.by_cell.items():
            for number in range(count):
                won = number < successes
                yield Episode(
                    arm=evaluation.condition, replicate=evaluation.replicate, cell=cell, scene=f"{cell}/{number}",
                    outcome="success" if won else "failure", reason="" if won else "not_lifted",
                    instruction=f"Do {cell}", steps=40, bag=f"evaluate/{evaluation.condition}/episodes/{number}",
                    start=_start(rng), drawn=_drawn(rng),
                )  # fmt: skip


if __name__ == "__main__":
    main()
