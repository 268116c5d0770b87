"""What a robot says of itself in a few lines: "This robot" on the page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def page_lines(status: Mapping[str, Any]) -> dict[str, str]:
    """Name -> text, in the order in which they are shown; what is not known is left out."""
    mapping, network, fused = status["mapping"], status["network"], status["global"]
    lines = {
        "mapping": str(mapping.get("status", "waiting for the first scan")),
        "known": f"{mapping.get('known_m2', 0)} m²",
        "scans": f"{mapping['scans']} ({mapping['scans_lost']} lost)",
        "CPU per scan": f"{mapping['cpu_ms_per_scan']} ms" if mapping["cpu_ms_per_scan"] else "",
        **{d["name"]: f"{d['state']} {d['rate_hz']:.1f} Hz {d['model']}" for d in status["devices"]},
        "security": network["security"],
        "links": str(len(network["links"])),
        "sent": f"{(network['sent_bytes'] + network['served_bytes']) / 1024:.0f} KB",
        "received": f"{(network['received_bytes'] + network['pulled_bytes']) / 1024:.0f} KB",
    }
    if fused:
        lines["fleet map"] = f"{fused['known_m2']} m², {fused['conflicting_cells']} cells conflict"
    return {name: value for name, value in lines.items() if value}
