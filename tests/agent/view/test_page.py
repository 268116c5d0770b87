"""The live page in a real browser: it shows, it is used with mouse and keyboard, it comes back after a lost connection."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from agent.view.server import ViewServer
from protocol.features import FeatureMap
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.harness.browser import Browser, chromium
from tests.harness.waiting import until

pytestmark = pytest.mark.skipif(chromium() is None, reason="no chromium on this machine: apt install chromium")

INK = "(() => { const d = document.getElementById('map').getContext('2d').getImageData(0, 0, 4000, 4000).data; let n = 0; "
INK += "for (let i = 3; i < d.length; i += 4) n += d[i] > 0; return n; })()"  # painted pixels


def room(side: int) -> OccupancyGrid:
    cells = np.full((side, side), UNKNOWN, np.int8)
    cells[2:-2, 2:-2] = FREE
    cells[2, 2:-2] = cells[-3, 2:-2] = cells[2:-2, 2] = cells[2:-2, -3] = OCCUPIED
    return OccupancyGrid(cells, 0.05)


UNDECIDED = {
    "peer": "r9", "status": "ambiguous", "match_factor": 0.91, "overlap_m2": 20, "reason": "second best as good", "uptime_s": 9.5,
    "purpose": "search", "score": 19.4, "runner_up": 17.9, "candidates": 37, "T_ours_theirs": [1, 1, 0.5],
    "alternatives": [[3, 2, 0, 17.9]],
}  # fmt: skip


class Fleet:
    """Two robots that have merged; a third may join, and a fourth fits in two places."""

    def __init__(self) -> None:
        self.grids = {"global": room(120), "r1": room(100), "r2": room(80)}
        self.undecided: list[dict[str, Any]] = []
        self.x_m = 2.0
        self.mapping: dict[str, Any] = {"scans": 12}

    def status(self) -> Mapping[str, Any]:
        maps = {
            name: {"version": "1", "width": g.width, "height": g.height, "resolution_m": g.resolution_m, "origin": [0, 0, 0]}
            for name, g in self.grids.items()
        }
        robots = [name for name in self.grids if name not in ("global", "r9")]
        return {
            "robot": "r1",
            "group": robots,
            "root": "r1",
            "frames": {name: [0, 0, 0] for name in robots},
            "poses": {name: [self.x_m, 2, 0.5] for name in robots},
            "maps": maps,
            "mapping": self.mapping,
            "peers": [{"robot": name, "state": "alive", "age_s": 1, "match_factor": 0.97} for name in robots if name != "r1"],
            "attempts": [
                {"peer": "<b>r2</b>", "status": "no", "match_factor": 0.7, "overlap_m2": 12, "reason": "little wall"},
                *self.undecided,
            ],
            "problems": [],
            "facts": {"scans": "12"},
        }

    def grid(self, name: str) -> tuple[str, OccupancyGrid] | None:
        return ("1", self.grids[name]) if name in self.grids else None

    def features(self, name: str) -> FeatureMap | None:
        return FeatureMap(lines=np.array([[2, 1, 1.57, 3, 0.01, 0.01]], np.float32), circles=np.ones((1, 4), np.float32))

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


def colours(browser: Browser, hue: tuple[int, int, int]) -> int:
    """Pixels of a colour on the map."""
    r, g, b = hue
    near = f"Math.abs(d[i]-{r})+Math.abs(d[i+1]-{g})+Math.abs(d[i+2]-{b})<12 && d[i+3]>250"
    return int(browser.run(INK.replace("n += d[i] > 0", f"n += {near}").replace("i = 3", "i = 0")))


def test_features_are_drawn_when_asked_for(browser: Browser, server: ViewServer) -> None:
    browser.dark(False)
    show(browser, server)
    line, round_wall = (0x0B, 0x62, 0xD6), (0x1D, 0x7A, 0x46)
    assert not any("features" in url for url in browser.requests)
    assert colours(browser, line) == 0
    browser.run("document.getElementById('mark-features').click()")
    until(lambda: colours(browser, line) > 100 and colours(browser, round_wall) > 100)
    browser.run("document.getElementById('mark-features').click()")
    until(lambda: colours(browser, line) == 0)


def test_a_map_that_fits_in_two_places_is_shown_in_both(browser: Browser, server: ViewServer, fleet: Fleet) -> None:
    ghost = (0x8A, 0x3B, 0x8F)
    show(browser, server)
    assert colours(browser, ghost) == 0
    fleet.grids["r9"] = room(60)
    fleet.undecided.append(UNDECIDED)
    until(lambda: colours(browser, ghost) > 300)
    browser.run("document.querySelector('#attempts button').focus()")
    browser.key("Enter")
    browser.until("document.querySelector('#attempts button').getAttribute('aria-pressed') == 'true'")
    said = browser.run("document.getElementById('chosen').textContent")
    assert said == "r9: 37 positions tried; the best has 19.4 m of common wall, the next 17.9 m. On the map: 1 to 2."
    browser.run("document.getElementById('mark-candidates').click()")
    until(lambda: colours(browser, ghost) == 0)


def test_places_where_a_loop_was_closed_are_marked(browser: Browser, server: ViewServer, fleet: Fleet) -> None:
    ring = (0x9A, 0x67, 0x00)
    show(browser, server)
    assert browser.run("document.getElementById('mark-closures')") is None  # nothing to show, so no box
    fleet.mapping = {"scans": 13, "loops_closed": 1, "closures": [[3, 3]]}
    until(lambda: colours(browser, ring) > 30)
    assert "loops closed1" in browser.run("document.getElementById('self').textContent")
    browser.run("document.getElementById('mark-closures').click()")
    until(lambda: colours(browser, ring) == 0)


def test_a_button_stays_under_the_finger_while_news_comes(browser: Browser, server: ViewServer, fleet: Fleet) -> None:
    fleet.grids["r9"] = room(60)
    fleet.undecided.append(UNDECIDED)
    show(browser, server)
    browser.run("document.querySelector('#attempts button').focus()")
    browser.run("document.querySelector('#attempts button').dataset.seen = 'old'")
    fleet.x_m = 2.4
    browser.until("status.poses.r1[0] == 2.4")
    assert browser.run("document.activeElement.dataset.seen") == "old"
    fleet.undecided.append(dict(UNDECIDED, uptime_s=11.5))
    browser.until("document.querySelectorAll('#attempts button').length == 2")
    assert browser.run("document.activeElement.dataset.key") == "r9 9.5 search"


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
