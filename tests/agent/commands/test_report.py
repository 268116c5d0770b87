"""`mapquilt report`: one page, everything inside, every attempt with its reason, and nothing a hostile peer could smuggle in."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

from agent.commands.report import span
from agent.merging.result import Reason
from agent.runtime.state import StateDirectory
from agent.view.report_page import REASONS, RobotReport, report_page
from tests.agent.commands.conftest import Run
from tests.agent.commands.test_export import saved  # noqa: F401  a state directory with a map

ATTEMPT = {
    "event": "merge-attempt", "time": "2026-01-01T00:00:00+0000", "uptime_s": 12.5, "peer": "r2", "purpose": "search",
    "status": "no", "reason": "little common wall", "match_factor": 0.91, "overlap_m2": 7.25, "score": 3.5, "runner_up": 1.25,
    "T_ours_theirs": [1, 2, 0.5],
}  # fmt: skip
HOSTILE = "<script>alert(1)</script>'\"><img src=http://evil/x onerror=alert(1)>"


class Page(HTMLParser):
    """Tags, their attributes and the text of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data + " "


def write_records(folder: Path, records: list[object]) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "records.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    return folder


def test_a_run_becomes_a_page_that_says_why(run: Run, saved: Path, tmp_path: Path) -> None:  # noqa: F811
    write_records(
        saved,
        [{"event": "peer-joined", "peer": "r2", "uptime_s": 1.0}, ATTEMPT, {**ATTEMPT, "status": "merged", "reason": "matched"}],
    )
    ended = run("report", saved, "-o", tmp_path / "page" / "report.html")
    assert (ended.code, ended.err) == (0, f"wrote {tmp_path}/page/report.html\n")
    page = Page((tmp_path / "page" / "report.html").read_text())
    assert "found a fit with r2" in page.text
    assert f"matched: {REASONS['matched']}" in page.text
    assert "12.5 r2 search" in page.text
    assert "3.5 / 1.2 1.00, 2.00, 0.50" in page.text
    assert "peer-joined peer r2" in page.text
    pictures = [attrs for tag, attrs in page.tags if tag == "img"]
    assert [str(picture["src"])[:22] for picture in pictures] == ["data:image/png;base64,"]


def test_the_page_asks_for_nothing_and_runs_nothing(run: Run, saved: Path, tmp_path: Path) -> None:  # noqa: F811
    bad = {
        **ATTEMPT,
        "peer": HOSTILE,
        "reason": HOSTILE,
        "status": HOSTILE,
        "purpose": HOSTILE,
        "match_factor": HOSTILE,
        "T_ours_theirs": [HOSTILE] * 3,
    }
    write_records(
        saved, [bad, {"event": HOSTILE, HOSTILE: HOSTILE, "time": HOSTILE, "uptime_s": HOSTILE}, {"event": "merge-attempt"}]
    )
    run("report", saved, "-o", tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text()
    page = Page(html)
    assert "default-src 'none'" in html
    assert not {tag for tag, _ in page.tags} & {"script", "link", "iframe", "object", "embed", "form", "a"}
    for tag, attrs in page.tags:
        assert not [name for name in attrs if name.startswith("on")], (tag, attrs)
        assert str(attrs.get("src", "data:")).startswith("data:"), (tag, attrs)
    assert "alert(1)" in page.text  # as words


def test_several_robots_share_a_page_and_broken_lines_are_passed_over(run: Run, tmp_path: Path) -> None:
    one = write_records(tmp_path / "r1", [ATTEMPT])
    with (one / "records.jsonl").open("ab") as stream:
        stream.write(b'{"event": "merge-att')  # cut by a crash
        stream.write(b"\n[1, 2]\n\xff\xfe\n")
    two = write_records(tmp_path / "r7", [])
    StateDirectory(two).save("mapper", b"of another version")
    ended = run("report", one, two, "-o", tmp_path / "report.html")
    assert ended.code == 0
    text = Page((tmp_path / "report.html").read_text()).text
    assert "merge attempts 1" in text
    assert "r7" in text
    assert "does not fit this program and these settings" in text


def test_nothing_to_report_is_told(run: Run, tmp_path: Path) -> None:
    ended = run("report", tmp_path)
    assert ended.code == 4
    assert "neither records nor a map; give the state directory of a robot that ran" in ended.err


def test_every_reason_of_the_matcher_is_explained_and_no_other() -> None:
    codes = {value for name, value in vars(Reason).items() if name.isupper()}
    assert codes == set(REASONS)


def test_a_long_run_stays_a_readable_page() -> None:
    records = [{**ATTEMPT, "uptime_s": float(i)} for i in range(3000)]
    html = report_page([RobotReport("r1", records)], "long")
    assert "the last 500 of 3000 attempts" in html
    assert len(html) < 1_500_000


def test_a_robot_that_left_trying_to_the_other_says_so_and_times_read_well() -> None:
    joined = {"event": "peer-joined", "peer": "r1", "uptime_s": 3.0}
    assert "whose name comes first tries" in report_page([RobotReport("r2", [joined])], "run")
    assert "no other robot was heard" in report_page([RobotReport("r2", [])], "run")
    assert span("2026-11-22T21:00:10+0000", "2026-11-22T21:05:00+0000") == "2026-11-22 21:00:10 to 21:05:00"
    assert span("2026-11-22T23:59:10+0200", "2026-11-23T00:05:00+0200") == "2026-11-22 23:59:10+0200 to 2026-11-23 00:05:00+0200"
