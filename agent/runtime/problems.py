"""What is not as it should be with a robot, in words for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.fleet.state import FleetState
from hw.device import DeviceState

if TYPE_CHECKING:
    from agent.runtime.node import Node


def problems(node: Node, fleet: FleetState) -> list[str]:
    """What a person should know, one sentence each; empty when all is well."""
    said = []
    for name, device in (("lidar", node.lidar), ("wheels", node.wheels)):
        health = device.health() if device is not None else None
        if health is not None and health.state is not DeviceState.RUNNING:
            said.append(health.last_error or f"{name} {health.url}: {health.state.value}")
    if not node.fleet.exchange.is_open:
        said.append(f"no network: no router answers at {', '.join(node.config.fleet.connect)}; this robot maps on its own")
    if fleet.is_twin:
        said.append(f"another robot calls itself {node.robot}: this one, the younger, stays silent; give it another --id")
    if node.map.is_paused:
        said.append("mapping is paused: mapquilt resume")
    if node.readings.scans_lost > 0.01 * max(100, node.readings.scans_in):
        lost, came = node.readings.scans_lost, node.readings.scans_in
        said.append(f"{lost} of {came} scans lost: this computer is too slow, lower mapping.particles")
    said += [f"worker {name} makes no progress" for name in node.health.stuck]
    said += [f"worker {r.name} fails: {r.last_error}; please report this with the log" for r in node.reports() if r.is_failing]
    if node.state is not None and node.state.last_error:
        said.append(f"state: {node.state.last_error}; mapping goes on in memory")
    if node.records.last_error:
        said.append(f"records cannot be written: {node.records.last_error}; the newest are kept in memory")
    return said
