"""The studio in a real Firefox, on a virtual screen."""

import pytest
from browser import wait_for
from firefox import Firefox, find_firefox

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not find_firefox(), reason="no Firefox with an Xvfb: apt-get install firefox-esr xvfb"),
]


def test_the_page_opens_connects_draws_the_scene_and_obeys_keys(studio, bag):
    film = studio.open_bag(bag)
    with Firefox(width=1280, height=800) as firefox:
        firefox.open(studio.url)
        firefox.wait("document.documentElement.dataset.studioConnected === 'true'")
        firefox.wait("document.querySelector('#tick-facts')?.innerText.includes('0 of')")
        client = wait_for(lambda: next(iter(studio.site.viser.get_clients().values()), None), "the page's client")
        drawn = client.get_render(height=120, width=160)  # by the page's own WebGL
        assert drawn.shape[:2] == (120, 160)
        assert drawn[..., :3].reshape(-1, 3).std(axis=0).min() > 10  # a room with a robot, no empty canvas
        firefox.press(".")
        firefox.wait("document.querySelector('#tick-facts').innerText.includes('1 of')")
        assert studio.episode.tick == 1
        assert film.states[1].state_hash in firefox.text("#tick-facts")
        assert "No WebGL" not in firefox.text("body")
        asked = [url for url in firefox.requests if url.startswith(("http", "ws"))]
        assert asked
        assert all(f"//127.0.0.1:{studio.site.port}/" in url for url in asked), asked
        assert not firefox.errors
