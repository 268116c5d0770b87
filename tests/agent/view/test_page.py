"""The live page in a real browser: it shows, it is used with mouse and keyboard, it comes back after a lost connection."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from agent.view.server import ViewServer
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.harness.browser import Browser, chromium

pytestmark = pytest.mark.skipif(chromium() is None, reason="no chromium on this machine: apt install chromium")

INK = "(() => { const d = document.getElementById('map').getContext('2d').getImageData(0, 0, 4000, 4000).data; let n = 0; "
INK += "for (let i = 3; i < d.length; i += 4) n += d[i] > 0; return n; })()"  # painted pixels


def room(side: int) -> OccupancyGrid:
    cells = np.full((side, side), UNKNOWN, np.int8)
    cells[2:-2, 2:-2] = FREE
    cells[2, 2:-2] = cells[-3, 2:-2] = cells[2:-2, 2] = cells[2:-2, -3] = OCCUPIED
    return OccupancyGrid(cells, 0.05)


class Fleet:
    """Two robots that have merged; a third may join."""

    def __init__(self) -> None:
        self.grids = {"global": room(120), "r1": room(100), "r2": room(80)}

    def status(self) -> Mapping[str, Any]:
        maps = {
            name: {"version": "1", "width": g.width, "height": g.height, "resolution_m": g.resolution_m, "origin": [0, 0, 0]}
            for name, g in self.grids.items()
        }
        robots = [name for name in self.grids if name != "global"]
        return {
            "robot": "r1",
            "group": robots,
            "root": "r1",
            "frames": {name: [0, 0, 0] for name in robots},
            "poses": {name: [2, 2, 0.5] for name in robots},
            "maps": maps,
            "mapping": {},
            "peers": [{"robot": name, "state": "alive", "age_s": 1, "match_factor": 0.97} for name in robots if name != "r1"],
            "attempts": [{"peer": "<b>r2</b>", "status": "no", "match_factor": 0.7, "overlap_m2": 12, "reason": "little wall"}],
            "problems": [],
            "facts": {"scans": "12"},
        }

    def grid(self, name: str) -> tuple[str, OccupancyGrid] | None:
        return ("1", self.grids[name]) if name in self.grids else None

    def metrics(self) -> str:
        return ""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser(1200, 800) as running:
        yield running


@pytest.fixture
def fleet() -> Fleet:
    return Fleet()


@pytest.fixture
def server(fleet: Fleet) -> Iterator[ViewServer]:
    running = ViewServer(fleet, 0)
    running.start()
    yield running
    running.close()


def show(browser: Browser, server: ViewServer) -> None:
    browser.requests.clear()
    browser.errors.clear()
    browser.open(server.url)
    browser.until("document.getElementById('link').textContent == 'live'")
    browser.until(f"{INK} > 10000")


def test_the_fleet_map_is_drawn_and_nothing_is_asked_of_others(browser: Browser, server: ViewServer) -> None:
    show(browser, server)
    assert browser.run("document.getElementById('said').textContent") == "r1: 2 robots share one map"
    own = urlsplit(server.url).netloc
    assert {urlsplit(url).netloc for url in browser.requests if not url.startswith("data:")} == {own}
    assert browser.errors == []


def test_what_a_peer_says_is_text_and_never_markup(browser: Browser, server: ViewServer) -> None:
    show(browser, server)
    assert "<b>r2</b>" in browser.run("document.getElementById('attempts').textContent")
    assert browser.run("document.querySelectorAll('#attempts b').length") == 0


def test_each_robots_map_is_shown_and_hidden_by_its_box(browser: Browser, server: ViewServer) -> None:
    show(browser, server)
    browser.run("document.getElementById('layer-global').click()")
    browser.until(f"{INK} < 10000")  # only robots and trails are left
    browser.run("document.getElementById('layer-r2').click()")
    browser.until(f"{INK} > 10000")


def test_the_keyboard_moves_zooms_and_shows_all(browser: Browser, server: ViewServer) -> None:
    show(browser, server)
    browser.run("document.getElementById('map').focus()")
    before = browser.run("document.getElementById('scale').style.width + document.getElementById('scale').textContent")
    for key in ("+", "+", "ArrowLeft"):
        browser.key(key)
    zoomed = "document.getElementById('scale').style.width + document.getElementById('scale').textContent"
    browser.until(f"{zoomed} != {before!r}")
    browser.key("0")
    browser.until(f"{zoomed} == {before!r}")


def test_a_late_joiner_appears_without_a_reload(browser: Browser, server: ViewServer, fleet: Fleet) -> None:
    show(browser, server)
    fleet.grids["r3"] = room(60)
    browser.until("document.getElementById('layer-r3') !== null")
    assert "3 robots share one map" in browser.run("document.getElementById('said').textContent")


def test_a_lost_connection_is_said_and_comes_back(browser: Browser, fleet: Fleet) -> None:
    first = ViewServer(fleet, 0)
    first.start()
    show(browser, first)
    port = urlsplit(first.url).port
    assert port is not None
    first.close()
    browser.until("document.getElementById('link').textContent != 'live'")
    again = ViewServer(fleet, port)
    again.start()
    browser.until("document.getElementById('link').textContent == 'live'", 20.0)
    again.close()


def test_it_fits_a_phone_in_light_and_dark(server: ViewServer, tmp_path: Path) -> None:
    with Browser(390, 844) as phone:
        pictures = []
        for is_dark in (False, True):
            phone.dark(is_dark)
            show(phone, server)
            assert phone.run("document.documentElement.scrollWidth <= innerWidth")
            phone.screenshot(tmp_path / "phone.png")
            pictures.append((tmp_path / "phone.png").read_bytes())
        assert pictures[0] != pictures[1]
