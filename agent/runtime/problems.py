"""What is not as it should be with a robot, in words for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.fleet.state import FleetState
from agent.runtime.map_worker import MapWorker
from hw.device import DeviceState

if TYPE_CHECKING:
    from agent.runtime.node import Node


HELD_SCANS = 20  # in a row: 2 s at 10 Hz; a door sill takes less
POOR_FIT = 0.6  # of a scan on mapped walls; 0.9 is usual indoors, a campus of bushes fell to 0.67


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
    said += mapping_problems(node.map)
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


def mapping_problems(worker: MapWorker) -> list[str]:
    """Scans that are not believed, wheels that do not tell what the scans show, scans that fit the map ever worse."""
    said, estimate = [], worker.newest
    if worker.held >= HELD_SCANS:
        said.append(f"nothing is drawn: {worker.held_reason}")
    if estimate is None:
        return said
    if estimate.wheels is not None:
        said += estimate.wheels.sentences()
    if estimate.usual_fraction < POOR_FIT:
        said.append(
            f"the scans fit the map badly, {estimate.usual_fraction:.0%} of them lies on its walls: the map may be bent, or the"
            " LIDAR was moved or tilts; look at the map, and mapquilt reset when it is wrong"
        )
    return said
