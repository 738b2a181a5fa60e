import html
import re

import pytest

import roboxim
from roboxim_core.errors import ConfigError


def test_an_episode_is_a_frame_of_a_notebook_that_asks_nobody(bag, run, tmp_path):
    view = roboxim.view(run)
    shown = view._repr_html_()
    page = html.unescape(re.search('srcdoc="([^"]*)"', shown)[1])
    assert page == view.page == view.save(tmp_path / "episode.html").read_text()
    assert "default-src 'none'" in page
    assert 'sandbox="allow-scripts"' in shown
    assert bag.name in repr(view)
    assert len(repr(view)) < 200
    assert str(tmp_path) not in page


def test_what_is_no_episode_is_named(run, tmp_path):
    with pytest.raises(ConfigError, match="1 episode, from 0"):
        roboxim.view(run, episode=1)
    with pytest.raises(ConfigError, match="a task"):
        roboxim.view("pick_cube")


@pytest.mark.slow
def test_the_frame_plays_in_a_browser(bag, chromium, tmp_path):
    file = tmp_path / "notebook.html"
    file.write_text(f"<body>{roboxim.view(bag)._repr_html_()}</body>")
    chromium.open(file.as_uri())
    chromium.wait("document.querySelector('iframe')")
    chromium.run("new Promise(done => setTimeout(done, 3000))")
    assert not [url for url in chromium.requests if not url.startswith(("file:", "data:", "blob:", "about:"))]
    assert not chromium.errors
