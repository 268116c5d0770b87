"""A run as one HTML page that needs nothing else: pictures inside, no script, no request, light and dark.

Everything that came from a robot is escaped; records are other people's words.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Record = Mapping[str, Any]

GATE = 0.85  # the paper's match factor
SHOWN_EVENTS = 500
CHART_W, CHART_H, CHART_PAD = 900, 220, 34
REASONS = {  # reason code: what it means for the person who reads it
    "matched": "the maps fit, in one way only",
    "empty map": "one of the maps knows too little yet: drive on",
    "no candidates": "no two features speak for a common place yet: drive on, or drive where the other robot was",
    "little common wall": "too few metres of wall seen by both: more overlap is needed",
    "low match factor": "too many cells contradict each other at the best place",
    "walls conflict": "one robot saw walls where the other saw free space",
    "unobservable direction": "the common walls are parallel: the maps could slide along them",
    "looks like another place of the same kind": "such walls stand in many places of such a building: more map will tell",
    "second best as good": "there is a second place that fits as well: the building repeats itself, more map will tell",
}
STYLE = """
:root{color-scheme:light dark;--ink:#222;--faint:#666;--paper:#fff;--line:#ddd;--good:#1a7f37;--maybe:#9a6700;--bad:#b42318}
@media(prefers-color-scheme:dark){:root{--ink:#e6e6e6;--faint:#9a9a9a;--paper:#161616;--line:#333;--good:#4ac26b;--maybe:#d4a72c;--bad:#f47067}}
body{font:15px/1.45 system-ui,sans-serif;color:var(--ink);background:var(--paper);margin:2rem auto;max-width:64rem;padding:0 1rem}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}p,caption{color:var(--faint)}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;font-size:.9rem}
caption{text-align:left;padding:.3rem 0}
th,td{text-align:left;padding:.25rem .6rem .25rem 0;border-bottom:1px solid var(--line);vertical-align:top}
.scroll{overflow-x:auto}img{max-width:100%;border:1px solid var(--line)}figure{margin:1rem 0}svg{max-width:100%;height:auto}
.merged{color:var(--good)}.ambiguous{color:var(--maybe)}.no{color:var(--bad)}svg text{fill:var(--faint);font-size:12px}
""".strip()
MARKS = {"merged": "●", "ambiguous": "▲", "no": "✕"}  # a shape each, for those who do not see colours


@dataclass(frozen=True, slots=True)
class RobotReport:
    """What one robot left behind."""

    robot: str
    records: Sequence[Record]
    figures: Sequence[tuple[str, str]] = ()  # (name, value)
    pictures: Sequence[tuple[str, bytes]] = ()  # (caption, PNG)


def report_page(robots: Sequence[RobotReport], title: str) -> str:
    """The whole page."""
    body = "".join(part for robot in robots for part in _robot(robot))
    return (
        "<!doctype html>\n<html lang=en><head><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width,initial-scale=1'>"
        "<meta http-equiv=Content-Security-Policy content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">"
        f"<title>{_text(title)}</title><style>{STYLE}</style></head><body><h1>{_text(title)}</h1>\n{body}</body></html>\n"
    )


def _robot(report: RobotReport) -> Iterator[str]:
    attempts = [record for record in report.records if record.get("event") == "merge-attempt"]
    yield f"<section><h2>{_text(report.robot)}</h2>\n"
    if report.figures:
        rows = "".join(f"<tr><th scope=row>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in report.figures)
        yield f"<table>{rows}</table>\n"
    for caption, png in report.pictures:
        source = base64.b64encode(png).decode()
        image = f"<img alt='{_text(caption)}' src='data:image/png;base64,{source}'>"
        yield f"<figure>{image}<figcaption>{_text(caption)}</figcaption></figure>\n"
    yield _peers(attempts, any(record.get("event") == "peer-joined" for record in report.records))
    yield _chart(attempts)
    yield _attempts(attempts)
    yield _events([record for record in report.records if record.get("event") != "merge-attempt"])
    yield "</section>\n"


def _peers(attempts: Sequence[Record], has_met: bool) -> str:
    """Who merged and who did not, and why: one line a peer."""
    if not attempts and has_met:
        return "<p>It tried no merge itself: of two robots the one whose name comes first tries, and its page says why.</p>\n"
    if not attempts:
        return "<p>No merge was tried: no other robot was heard.</p>\n"
    rows = []
    for peer in sorted({str(record.get("peer")) for record in attempts}):
        mine = [record for record in attempts if str(record.get("peer")) == peer]
        best = max(_number(record.get("match_factor")) for record in mine)
        reason = str(mine[-1].get("reason", ""))
        why = f"{reason}: {REASONS[reason]}" if reason in REASONS else reason
        rows.append(_row(_text(peer), len(mine), f"{best:.3f}", _status(mine[-1]), _text(why)))
    heads = ("peer", "attempts", "best match factor", "last answer", "why")
    return f"<h3>Why it merged, or did not</h3>{_table(heads, rows)}"


def _chart(attempts: Sequence[Record]) -> str:
    """Match factor of every attempt over time, with the gate."""
    if not attempts:
        return ""
    end_s = max(1.0, *(_number(record.get("uptime_s")) for record in attempts))

    def x(uptime_s: float) -> float:
        return CHART_PAD + (CHART_W - 2 * CHART_PAD) * uptime_s / end_s

    def y(factor: float) -> float:
        return CHART_H - CHART_PAD - (CHART_H - 2 * CHART_PAD) * min(max(factor, 0.0), 1.0)

    parts = [_level(y(factor), f"{factor:g}", "stroke='var(--line)'") for factor in (0, 0.5, 1)]
    parts.append(_level(y(GATE), f"{GATE:g}", "stroke='var(--maybe)' stroke-dasharray='6 4'"))
    for record in attempts:
        at, factor, kind = _number(record.get("uptime_s")), _number(record.get("match_factor")), _kind(record)
        note = f"{record.get('peer')} at {at:.0f} s: {record.get('status')}, match factor {factor:.3f}"
        parts.append(
            f"<text class={kind} x={x(at):.1f} y={y(factor) + 4:.1f} text-anchor=middle style='fill:currentColor'>"
            f"<title>{_text(note)}</title>{MARKS[kind]}</text>"
        )
    parts.append(f"<text x={CHART_W - CHART_PAD} y={CHART_H - 8} text-anchor=end>{end_s:.0f} s since the start</text>")
    legend = ", ".join(f"{mark} {kind}" for kind, mark in MARKS.items())
    words = f"Match factor of every attempt: {legend}. Above the gate ({GATE:g}) is needed, and not enough."
    label = "match factor of every attempt over time"
    svg = f"<svg viewBox='0 0 {CHART_W} {CHART_H}' role=img aria-label='{label}'>{''.join(parts)}</svg>"
    return f"<figure>{svg}<figcaption>{words}</figcaption></figure>\n"


def _level(y: float, text: str, stroke: str) -> str:
    line = f"<line x1={CHART_PAD} x2={CHART_W - CHART_PAD} y1={y:.0f} y2={y:.0f} {stroke}/>"
    return f"{line}<text x=4 y={y + 4:.0f}>{text}</text>"


def _attempts(attempts: Sequence[Record]) -> str:
    if not attempts:
        return ""
    rows = []
    for record in attempts[-SHOWN_EVENTS:]:
        T = record.get("T_ours_theirs")
        place = ", ".join(f"{_number(value):.2f}" for value in T) if isinstance(T, list) else ""
        rows.append(
            _row(
                f"{_number(record.get('uptime_s')):.1f}",
                _text(record.get("peer")),
                _text(record.get("purpose", "")),
                _status(record),
                f"{_number(record.get('match_factor')):.3f}",
                f"{_number(record.get('overlap_m2')):.1f}",
                f"{_number(record.get('score')):.1f} / {_number(record.get('runner_up')):.1f}",
                _text(record.get("candidates", "")),
                place,
                _text(record.get("reason", "")),
            )
        )
    heads = (
        "s",
        "peer",
        "purpose",
        "answer",
        "match factor",
        "overlap m²",
        "score / runner-up",
        "tried",
        "x m, y m, yaw rad",
        "reason",
    )
    which = "every attempt" if len(attempts) == len(rows) else f"the last {len(rows)} of {len(attempts)} attempts"
    return f"<details><summary>The numbers of {which}</summary>{_table(heads, rows)}</details>\n"


def _events(events: Sequence[Record]) -> str:
    if not events:
        return ""
    rows = []
    for record in events[-SHOWN_EVENTS:]:
        facts = ", ".join(f"{name} {value}" for name, value in record.items() if name not in ("event", "time", "uptime_s"))
        at = f"{_number(record.get('uptime_s')):.1f}"
        rows.append(_row(_text(record.get("time", "")), at, _text(record.get("event")), _text(facts)))
    return f"<h3>What else happened</h3>{_table(('time', 's', 'event', 'facts'), rows)}"


def _table(heads: Sequence[str], rows: Sequence[str]) -> str:
    """On a phone a wide table scrolls by itself."""
    head = "".join(f"<th scope=col>{text}</th>" for text in heads)
    return f"<div class=scroll><table><tr>{head}</tr>{''.join(rows)}</table></div>\n"


def _row(*cells: object) -> str:
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _kind(record: Record) -> str:
    status = str(record.get("status"))
    return status if status in MARKS else "no"


def _status(record: Record) -> str:
    kind = _kind(record)
    return f"<span class={kind}>{MARKS[kind]} {_text(record.get('status', ''))}</span>"


def _number(value: object) -> float:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else 0.0


def _text(value: object) -> str:
    return html.escape(str(value), quote=True)
