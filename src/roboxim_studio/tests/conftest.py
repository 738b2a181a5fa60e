import pytest
from browser import Browser, find_browser

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_runs.episodes.task_choice import task_text
from roboxim_studio.app import Studio


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A folder with one episode of the expert."""
    folder = tmp_path_factory.mktemp("studio") / "run"
    config = RunConfig(
        run_seed=1, purpose="demo", task_config=task_text("pick_cube"), output_dir=str(folder), image_width=128,
        image_height=128,
    )  # fmt: skip
    with CoreGraph(folder) as graph:
        result = EpisodeRunner(graph.ports, config, library=graph.sim.library).run_index(0)
    assert result.outcome == "success"
    return folder


@pytest.fixture(scope="session")
def bag(run):
    return next((run / "episodes").iterdir())


@pytest.fixture
def studio():
    with Studio() as studio:
        yield studio


@pytest.fixture(scope="session")
def started_chromium():
    """One browser for all tests that need one."""
    if not find_browser():
        pytest.skip("no Chromium is installed: apt-get install chromium, or name one in ROBOXIM_CHROMIUM")
    with Browser() as browser:
        yield browser


@pytest.fixture
def chromium(started_chromium):
    """The browser with an empty page."""
    browser = started_chromium
    browser.open("about:blank")
    browser.resize(1400, 800)
    browser.wait("location.href === 'about:blank'")
    browser.requests.clear()
    browser.errors.clear()
    return browser
