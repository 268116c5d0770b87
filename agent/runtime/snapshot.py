"""The whole robot at one moment, as plain values: what `status`, the page, the demo and the harness read.

`frames` are T_global_map, `poses` are each robot in its own map; both are [x_m, y_m, theta_rad].
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from agent.fleet.state import FleetState
from agent.mapping.wheel_check import WheelFigures
from agent.runtime.problems import problems
from hw.device import Source
from protocol.geometry import SE2
from protocol.grid import OccupancyGrid

if TYPE_CHECKING:
    from agent.runtime.node import Node

GLOBAL = "global"


def plain_pose(pose: SE2) -> list[float]:
    return [round(pose.x_m, 4), round(pose.y_m, 4), round(pose.theta_rad, 5)]


def snapshot(node: Node) -> dict[str, Any]:
    """Everything there is to say, in JSON values."""
    fleet = node.fleet.state()
    frames = {robot: plain_pose(frame.T_global_map) for robot, frame in fleet.frames.items()}
    frames.setdefault(node.robot, [0.0, 0.0, 0.0])
    return {
        "robot": node.robot,
        "fleet": node.config.fleet.name,
        "boot": f"{node.boot_id:016x}",
        "uptime_s": round(time.monotonic() - node.started_s, 1),
        "is_paused": node.map.is_paused,
        "mapping": mapping(node),
        "devices": devices(node),
        "root": fleet.root,
        "composer": fleet.composer,
        "group": sorted(fleet.frames) if len(fleet.frames) > 1 else [],
        "frames": frames,
        "covariances": {robot: list(frame.covariance) for robot, frame in fleet.frames.items()},
        "poses": poses(node, fleet),
        "odometry": odometry(node),
        "peers": peers(fleet),
        "edges": edges(node, fleet),
        "merge_times": node.records.merge_times(),
        "global": global_facts(node),
        "maps": maps(node),
        "attempts": node.records.of("merge-attempt"),
        "network": network(node),
        "workers": workers(node),
        "problems": problems(node, fleet),
        "has_estimate": node.map.newest is not None,
    }


def mapping(node: Node) -> dict[str, Any]:
    estimate, worker = node.map.newest, node.map
    facts: dict[str, Any] = {
        "scans": worker.scans,
        "scans_lost": node.readings.scans_lost,
        "odometry": node.readings.odometry_in,
        "cpu_ms_per_scan": round(1e3 * worker.scan_cpu_s / worker.scans, 2) if worker.scans else None,
    }
    if estimate is not None:
        facts |= {
            "revision": estimate.revision,
            "epoch": estimate.epoch,
            "status": str(getattr(estimate.status, "value", estimate.status)),
            "known_m2": round(estimate.grid.known_area_m2(), 2),
            "particles": round(estimate.effective_particles, 1),
            "loops_closed": estimate.loops_closed,
            "closures": [plain_pose(place)[:2] for place in list(worker.loop_places)],
            "fraction": round(estimate.usual_fraction, 3),
            "wheels": wheels(estimate.wheels),
            "pose": plain_pose(estimate.T_map_robot),
            "pose_stamp_s": estimate.stamp_s,
        }
    return facts


def wheels(figures: WheelFigures | None) -> dict[str, float | None] | None:
    """What the scans show beyond what the wheels tell, with standard errors; null until it is known."""
    if figures is None:
        return None
    degrees = {name: math.degrees(getattr(figures, name)) for name in ("drift_rad_m", "drift_error_rad_m", "slip_rad")}
    facts = {
        "length_percent": 100.0 * figures.length,
        "length_error_percent": 100.0 * figures.length_error,
        "turn_percent": 100.0 * figures.turn,
        "turn_error_percent": 100.0 * figures.turn_error,
        "drift_deg_m": degrees["drift_rad_m"],
        "drift_error_deg_m": degrees["drift_error_rad_m"],
        "slip_deg": degrees["slip_rad"],
        "stretches": float(figures.stretches),
    }
    return {name: round(value, 2) if math.isfinite(value) else None for name, value in facts.items()}


def devices(node: Node) -> list[dict[str, Any]]:
    return [device(name, source) for name, source in (("lidar", node.lidar), ("wheels", node.wheels)) if source is not None]


def device(name: str, source: Source) -> dict[str, Any]:
    health = source.health()
    return {
        "name": name,
        "url": health.url,
        "state": health.state.value,
        "model": health.model,
        "rate_hz": round(health.rate_hz, 2),
        "age_s": round(health.age_s, 2) if math.isfinite(health.age_s) else None,
        "points": health.points,
        "coverage": round(health.coverage, 3),
        "readings": health.readings,
        "bad_frames": health.bad_frames,
        "reconnects": health.reconnects,
        "error": health.last_error,
    }


def poses(node: Node, fleet: FleetState) -> dict[str, list[float]]:
    """Where every robot of our group is, in its own map."""
    found = {}
    for peer in fleet.peers:
        frame = fleet.frames.get(peer.robot)
        if frame is not None and peer.T_global_robot is not None and not peer.is_frozen:
            found[peer.robot] = plain_pose(frame.T_global_map.inverse() @ peer.T_global_robot)
    if node.map.newest is not None:
        found[node.robot] = plain_pose(node.map.newest.T_map_robot)
    return found


def odometry(node: Node) -> dict[str, list[float]] | None:
    """Where the wheels say we are, and what the map makes of it; None without wheels."""
    estimate, newest = node.map.newest, node.readings.newest_odometry
    if estimate is None or newest is None:
        return None
    T_odom_robot = SE2(newest.x_m, newest.y_m, newest.theta_rad)
    return {"T_map_odom": plain_pose(estimate.T_map_odom), "T_odom_robot": plain_pose(T_odom_robot)}


def peers(fleet: FleetState) -> list[dict[str, Any]]:
    return [
        {
            "robot": p.robot,
            "state": "quarantined" if p.is_quarantined else "unmerged" if p.is_unmerged else p.presence.value,
            "age_s": round(p.silent_s, 1),
            "is_frozen": p.is_frozen,
            "known_m2": round(p.known_area_m2, 1),
            "pair": p.pair,
            "reason": p.reason,
            "attempts": p.attempts,
            "match_factor": round(p.match_factor, 4) if p.match_factor else None,
            "strikes": p.strikes,
        }
        for p in fleet.peers
    ]


def edges(node: Node, fleet: FleetState) -> list[dict[str, Any]]:
    return [
        {
            "a": e.robot_a,
            "b": e.robot_b,
            "match_factor": round(e.match_factor, 4),
            "T_a_b": plain_pose(e.T_a_b),
            "is_used": e not in fleet.rejected_edges,
            "age_s": node.records.edge_age_s(e.robot_a, e.robot_b),
        }
        for e in fleet.edges
    ]


def global_facts(node: Node) -> dict[str, Any] | None:
    global_map = node.fleet.global_map
    if global_map is None:
        return None
    return {
        "digest": global_map.digest.hex(),
        "author": global_map.author,
        "members": [member.robot for member in global_map.members],
        "known_m2": round(global_map.grid.known_area_m2(), 2),
        "conflicting_cells": global_map.conflicting_cells,
        "agreeing_cells": global_map.agreeing_cells,
    }


def maps(node: Node) -> dict[str, dict[str, Any]]:
    peers = {name: (digest.hex(), grid) for name, (digest, grid) in node.fleet.peer_maps().items()}
    ours = {name: found for name in (GLOBAL, node.robot) if (found := grid_of(node, name)) is not None}
    return {
        name: {
            "version": version,
            "width": grid.width,
            "height": grid.height,
            "resolution_m": grid.resolution_m,
            "origin": [grid.origin.x_m, grid.origin.y_m, grid.origin.theta_rad],
        }
        for name, (version, grid) in {**peers, **ours}.items()
    }


def grid_of(node: Node, name: str) -> tuple[str, OccupancyGrid] | None:
    """(version, cells) of the global map, of our own, or of a peer's as it is held here."""
    if name == GLOBAL:
        global_map = node.fleet.global_map
        return None if global_map is None else (global_map.digest.hex(), global_map.grid)
    if name == node.robot:
        estimate = node.map.newest
        return None if estimate is None else (f"{estimate.epoch}.{estimate.revision}", estimate.grid)
    held = node.fleet.peer_maps().get(name)
    return None if held is None else (held[0].hex(), held[1])


def network(node: Node) -> dict[str, Any]:
    exchange, settings = node.fleet.exchange, node.fleet.settings
    return {
        "profile": settings.profile,
        "security": settings.security,
        "locators": node.keeper.locators,
        "links": node.keeper.links,
        **{name: getattr(exchange.traffic, name) for name in exchange.traffic.__slots__},
        "inbox_replaced": exchange.inbox.replaced,
        "inbox_dropped": exchange.inbox.dropped,
        "garbage": node.fleet.garbage,
    }


def workers(node: Node) -> list[dict[str, Any]]:
    return [
        {
            "name": r.name,
            "idle_s": round(r.idle_s, 1),
            "steps": r.steps,
            "cpu_s": round(r.cpu_s, 2),
            "errors": r.errors,
            "error": r.last_error,
            "stuck": r.is_stuck,
        }
        for r in node.reports()
    ]
