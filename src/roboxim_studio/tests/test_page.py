"""The studio in a real browser: its DOM, and the server's state."""

import pytest
from browser import Browser


@pytest.mark.thorough
def test_scrubbing_in_the_page_moves_the_server_and_asks_nobody_else(studio, bag, chromium):
    film = studio.open_bag(bag)
    chromium.open(studio.url)
    chromium.wait("document.querySelector('#tick-facts')?.innerText.includes('0 of')")
    chromium.wait("document.documentElement.dataset.studioConnected === 'true'")
    for _ in range(2):
        chromium.key("Period", down=True)
        chromium.key("Period", down=False)
    chromium.wait("document.querySelector('#tick-facts').innerText.includes('2 of')")
    assert studio.episode.tick == 2
    assert film.states[2].state_hash in chromium.text("#tick-facts")
    chromium.click("Last")
    last = len(film) - 1
    chromium.wait(f"document.querySelector('#tick-facts').innerText.includes('{last} of {last}')")
    chromium.wait("document.querySelector('tr[data-condition=lifted]')?.dataset.holds === '1'")
    asked = [url for url in chromium.requests if not url.startswith(("data:", "blob:", "about:"))]
    assert asked
    assert all(f"//127.0.0.1:{studio.site.port}/" in url + "/" for url in asked), asked
    assert not chromium.errors


@pytest.mark.slow
def test_a_page_that_is_cut_off_comes_back_and_nothing_scrolls_sideways_on_a_phone(studio, bag, chromium):
    studio.open_bag(bag)
    chromium.resize(390, 844, 2.0, phone=True)
    chromium.open(studio.url)
    chromium.wait("document.documentElement.dataset.studioConnected === 'true'")
    chromium.wait("document.querySelector('canvas') && document.body.innerText.includes('RoboXim studio')")
    assert chromium.run("document.documentElement.scrollWidth") <= 390
    studio.site.cut()
    chromium.wait("document.documentElement.dataset.studioOpened === '2'")
    chromium.wait("document.documentElement.dataset.studioConnected === 'true'")
    studio.episode.show(3)
    assert studio.episode.tick == 3


@pytest.mark.slow
def test_two_browsers_at_once_show_the_same(studio, bag, chromium):
    studio.open_bag(bag)
    with Browser(width=500, height=400) as other:
        for page in (chromium, other):
            page.open(studio.url)
            page.wait("document.querySelector('#tick-facts')")
            page.wait("document.documentElement.dataset.studioConnected === 'true'")
        assert studio.site.pages == 2
        other.key("Period", down=True)
        other.key("Period", down=False)
        for page in (chromium, other):
            page.wait("document.querySelector('#tick-facts').innerText.includes('1 of')")
        other.open("about:blank")
        chromium.key("Period", down=True)
        chromium.key("Period", down=False)
        chromium.wait("document.querySelector('#tick-facts').innerText.includes('2 of')")


@pytest.mark.slow
def test_words_of_a_bag_are_text_in_the_page(studio, bag, chromium):
    from dataclasses import replace

    from roboxim_studio.episode.film import read_film

    film = read_film(bag)
    evil = '<img src=x onerror="window.evil = 1"><script>window.evil = 1</script>'
    task = replace(film.info.task, instruction=evil)
    studio.watch(replace(film, title=evil, info=replace(film.info, task=task, actor=evil)))
    chromium.open(studio.url)
    chromium.wait("document.querySelector('#episode-facts')?.innerText.includes('onerror')")
    assert not chromium.run("!!window.evil || !!document.querySelector('img[src=x]')")
