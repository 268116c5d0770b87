"""Records and metrics: what happened can be read later, by people and by machines."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from agent.fleet.effects import Note
from agent.runtime.merge_times import MergeTimes
from agent.runtime.metrics import metrics
from agent.runtime.records import KEPT, Records

STATUS: dict[str, Any] = {
    "robot": "r1",
    "uptime_s": 12.5,
    "problems": [],
    "group": ["r1", "r2"],
    "global": {"known_m2": 31.5, "conflicting_cells": 7},
    "mapping": {"scans": 120, "scans_lost": 1, "cpu_ms_per_scan": 7.5, "known_m2": 20.0},
    "network": {"links": ["tcp/1"], "sent_bytes": 10, "served_bytes": 5, "received_bytes": 7, "pulled_bytes": 1, "garbage": 2},
    "devices": [{"name": "lidar", "state": "running", "rate_hz": 10.0, "reconnects": 0}],
    "peers": [{"robot": 'r"2\n', "age_s": 0.5, "match_factor": 0.97, "attempts": 3}],
    "edges": [{"a": "r1", "b": 'r"2\n', "age_s": 3.5}],
    "merge_times": {"peers": 1, "p50_s": 4.2, "p90_s": 4.2, "max_s": 4.2},
    "workers": [{"name": "map", "idle_s": 0.1, "cpu_s": 1.5, "errors": 0}],
}


def test_every_merge_attempt_is_one_line_on_disk(tmp_path: Path) -> None:
    records = Records(tmp_path / "deep" / "records.jsonl")
    records.add(Note("merge-attempt", {"peer": "r2", "match_factor": 0.97, "digest": b"\x01", "T": (1.0, 2.0, float("nan"))}))
    records.add(Note("peer-joined", {"peer": "r2"}))
    lines = [json.loads(line) for line in (tmp_path / "deep" / "records.jsonl").read_text().splitlines()]
    assert [line["event"] for line in lines] == ["merge-attempt", "peer-joined"]
    assert (lines[0]["digest"], lines[0]["T"]) == ("01", [1.0, 2.0, None])
    assert records.of("merge-attempt")[0]["peer"] == "r2"


def test_records_in_memory_are_bounded(tmp_path: Path) -> None:
    records = Records(None)
    for number in range(3 * KEPT):
        records.add(Note("merge-attempt", {"number": number}))
    assert len(records.newest(10 * KEPT)) == KEPT
    assert records.counts == {"merge-attempt": 3 * KEPT}


def test_a_disk_that_refuses_records_costs_nothing_but_the_records(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    records = Records(tmp_path / "file" / "records.jsonl")
    records.add(Note("merged", {"a": "r1", "b": "r2"}))
    assert records.of("merged")


def test_metrics_are_prometheus_text() -> None:
    text = metrics(STATUS)
    for line in text.splitlines():
        assert re.fullmatch(
            r'# (HELP|TYPE) mapquilt_[a-z_]+ .+|mapquilt_[a-z_]+\{([a-z]+="(\\.|[^"\\\n])*",?)+\} [0-9.e+-]+', line
        ), line
    assert 'mapquilt_network_bytes_total{robot="r1",direction="out"} 15' in text
    assert 'mapquilt_peer_match_factor{robot="r1",peer="r\\"2\\n"} 0.97' in text
    assert 'mapquilt_merge_seconds{robot="r1",quantile="0.9"} 4.2' in text
    assert 'mapquilt_edge_age_seconds{robot="r1",a="r1",b="r\\"2\\n"} 3.5' in text
    told = {"length_percent": 0.4, "turn_percent": 8.0, "drift_deg_m": 0.3, "slip_deg": 1.5}
    with_wheels = metrics({**STATUS, "mapping": {**STATUS["mapping"], "wheels": told}})
    assert 'mapquilt_wheels_error_ratio{robot="r1",of="turn"} 0.08' in with_wheels
    assert 'mapquilt_wheels_heading_degrees{robot="r1",of="slip"} 1.5' in with_wheels
    names = [line.split()[2] for line in text.splitlines() if line.startswith("# TYPE")]
    assert len(names) == len(set(names))


def test_times_to_merge_are_of_our_own_edges_and_edges_know_their_age() -> None:
    times = MergeTimes()
    for peer, heard_s in (("r2", 1.0), ("r3", 2.0), ("r4", 3.0)):
        times.add("peer-joined", {"peer": peer}, heard_s)
    times.add("merged", {"a": "r1", "b": "r2"}, 5.0)
    times.add("merged", {"a": "r2", "b": "r3"}, 6.0)
    times.add("merged", {"a": "r1", "b": "r3"}, 12.0)
    times.add("merged", {"a": "r1", "b": "r2"}, 20.0)
    assert times.took() == {"peers": 2, "p50_s": 4.0, "p90_s": 10.0, "max_s": 10.0}
    assert times.edge_age_s("r2", "r1", 21.0) == 1.0
    assert times.edge_age_s("r2", "r3", 21.0) == 15.0
    assert times.edge_age_s("r2", "r4", 21.0) is None
    times.add("peer-restarted", {"peer": "r3"}, 30.0)
    assert times.took() == {"peers": 1, "p50_s": 4.0, "p90_s": 4.0, "max_s": 4.0}
