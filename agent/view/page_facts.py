"""What the live page draws, out of what a status says: little enough to be told five times a second, and no secrets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from protocol.features import FeatureMap, FeatureTable

KEYS = ("robot", "focus", "group", "root", "frames", "poses", "odometry", "maps", "edges", "attempts", "problems", "facts")
PEER_KEYS = ("robot", "state", "pair", "reason", "match_factor", "known_m2")
TRAFFIC = ("sent_bytes", "served_bytes", "received_bytes", "pulled_bytes", "unanswered", "dropped_queries", "garbage")
NEWEST_ATTEMPTS = 20


def page_facts(status: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a status that the page knows how to show; ages in whole seconds, so that they are news once a second."""
    facts = {key: status[key] for key in KEYS if key in status}
    facts["attempts"] = list(status.get("attempts", []))[-NEWEST_ATTEMPTS:]
    facts["is_mapping"] = bool(status.get("mapping"))
    closed = status.get("mapping", {}).get("loops_closed", 0)
    facts["facts"] = {**status.get("facts", {}), **({"loops closed": str(closed)} if closed else {})}
    facts["closures"] = status.get("mapping", {}).get("closures", [])
    facts["peers"] = [
        {key: peer[key] for key in PEER_KEYS if key in peer} | {"age_s": round(peer.get("age_s") or 0)}
        for peer in status.get("peers", [])
    ]
    network = status.get("network", {})
    facts["network"] = {"links": network.get("links", [])} | {key: network[key] for key in TRAFFIC if key in network}
    return facts


def features_json(features: FeatureMap) -> dict[str, list[list[float]]]:
    """The feature map in strokes: lines [x, y, normal, length], arcs [x, y, radius, start, span], curves [x, y]."""
    circles = np.zeros((len(features.circles), 5), np.float32)
    circles[:, :3], circles[:, 4] = features.circles[:, :3], 2 * np.pi
    return {
        "lines": _rows(features.lines[:, :4]),
        "arcs": _rows(np.vstack([circles, features.arcs[:, :5]])),
        "curves": _rows(features.curves[:, :2]),
    }


def _rows(table: FeatureTable) -> list[list[float]]:
    return [[round(value, 3) for value in row] for row in table.tolist()]
