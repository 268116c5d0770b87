"""The status as Prometheus text: one table of what is exported, its kind, and what it means."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

Sample = tuple[Mapping[str, str], float]  # labels, value


def metrics(status: Mapping[str, Any]) -> str:
    """Prometheus text exposition, version 0.0.4."""
    lines = []
    for name, kind, text, samples in families(status):
        lines += [f"# HELP mapquilt_{name} {text}", f"# TYPE mapquilt_{name} {kind}"]
        for labels, value in samples:
            inside = ",".join(f'{key}="{escaped(word)}"' for key, word in {"robot": status["robot"], **labels}.items())
            lines.append(f"mapquilt_{name}{{{inside}}} {value:.10g}")
    return "\n".join(lines) + "\n"


def families(status: Mapping[str, Any]) -> Iterator[tuple[str, str, str, list[Sample]]]:
    """(name, kind, meaning, samples)."""
    mapping, network, fused = status["mapping"], status["network"], status["global"] or {}
    yield "uptime_seconds", "gauge", "Since the robot's process started.", [({}, status["uptime_s"])]
    yield "problems", "gauge", "Things a person should look at.", [({}, len(status["problems"]))]
    yield "scans_total", "counter", "Scans the mapper has seen.", [({}, mapping["scans"])]
    yield "scans_lost_total", "counter", "Scans that came faster than the mapper could follow.", [({}, mapping["scans_lost"])]
    yield "scan_cpu_seconds", "gauge", "CPU time per scan, on average.", [({}, (mapping["cpu_ms_per_scan"] or 0.0) / 1e3)]
    yield "map_known_square_metres", "gauge", "Area of the local map.", [({}, mapping.get("known_m2", 0.0))]
    yield "scan_fit_ratio", "gauge", "How much of the last scans lies on mapped walls.", [({}, mapping.get("fraction", 1.0))]
    wheels: Mapping[str, float] = mapping.get("wheels") or {}
    errors: list[Sample] = [({"of": of}, wheels[f"{of}_percent"] / 1e2) for of in ("length", "turn") if wheels]
    yield "wheels_error_ratio", "gauge", "Ways and turns that the scans show beyond what the wheels tell.", errors
    drifts: list[Sample] = [({"of": of}, wheels[name]) for of, name in (("drift", "drift_deg_m"), ("slip", "slip_deg")) if wheels]
    yield "wheels_heading_degrees", "gauge", "Off over one metre: always alike (drift), by chance (slip).", drifts
    yield "global_map_known_square_metres", "gauge", "Area of the fleet's map.", [({}, fused.get("known_m2", 0.0))]
    yield (
        "global_map_conflicting_cells",
        "gauge",
        "Cells on which robots disagree.",
        [({}, fused.get("conflicting_cells", 0))],
    )
    yield "group_robots", "gauge", "Robots in one map with this one, itself included.", [({}, max(1, len(status["group"])))]
    yield "links", "gauge", "Zenoh links.", [({}, len(network["links"]))]
    sent, received = network["sent_bytes"] + network["served_bytes"], network["received_bytes"] + network["pulled_bytes"]
    yield "network_bytes_total", "counter", "Payload bytes.", [({"direction": "out"}, sent), ({"direction": "in"}, received)]
    yield "network_garbage_total", "counter", "Messages that no robot of ours sends.", [({}, network["garbage"])]
    devices, peers, workers = status["devices"], status["peers"], status["workers"]
    yield "device_up", "gauge", "1 while a device runs.", [({"device": d["name"]}, d["state"] == "running") for d in devices]
    yield "device_rate_hertz", "gauge", "Readings a second.", [({"device": d["name"]}, d["rate_hz"]) for d in devices]
    yield (
        "device_reconnects_total",
        "counter",
        "Times a device came back.",
        [({"device": d["name"]}, d["reconnects"]) for d in devices],
    )
    yield "peer_silence_seconds", "gauge", "Since a peer was last heard.", [({"peer": p["robot"]}, p["age_s"]) for p in peers]
    factors: list[Sample] = [({"peer": p["robot"]}, p["match_factor"]) for p in peers if p["match_factor"] is not None]
    yield "peer_match_factor", "gauge", "Equation 3 of the last comparison with a peer.", factors
    attempts: list[Sample] = [({"peer": p["robot"]}, p["attempts"]) for p in peers]
    yield "peer_merge_attempts_total", "counter", "Comparisons with a peer.", attempts
    took = status.get("merge_times") or {}
    quantiles: list[Sample] = [({"quantile": q}, took[name]) for q, name in (("0.5", "p50_s"), ("0.9", "p90_s")) if name in took]
    yield "merge_seconds", "gauge", "From hearing a peer first to the first fit with its map.", quantiles
    ages: list[Sample] = [({"a": e["a"], "b": e["b"]}, e["age_s"]) for e in status.get("edges", []) if e["age_s"] is not None]
    yield "edge_age_seconds", "gauge", "Since an edge last began.", ages
    yield "worker_idle_seconds", "gauge", "Since a worker's last step.", [({"worker": w["name"]}, w["idle_s"]) for w in workers]
    yield "worker_cpu_seconds_total", "counter", "Of its thread.", [({"worker": w["name"]}, w["cpu_s"]) for w in workers]
    yield "worker_errors_total", "counter", "Steps that failed.", [({"worker": w["name"]}, w["errors"]) for w in workers]


def escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
