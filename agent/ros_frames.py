"""The tree of frames a fleet gives to ROS, after REP-105; `global` stands where REP-105 has `earth`.

global ─► r1/map ─► r1/odom ─► r1/base_link        the robot that publishes: it knows its own odometry
       └► r2/map ─► r2/base_link                   the others
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from protocol.geometry import SE2

GLOBAL = "global"
Link = tuple[str, str, SE2]  # parent, child, T_parent_child


def map_frame(name: str) -> str:
    """The frame of a map: the fleet's, or a robot's own."""
    return GLOBAL if name == GLOBAL else f"{name}/map"


def base_frame(robot: str) -> str:
    return f"{robot}/base_link"


def frame_links(status: Mapping[str, Any], name_of: Callable[[str], str]) -> Iterator[Link]:
    """Every link that a status (`agent/runtime/snapshot.py`) knows; `name_of` gives a robot's name in ROS."""
    for robot, T_global_map in status["frames"].items():
        yield GLOBAL, map_frame(name_of(robot)), SE2(*T_global_map)
    for robot, T_map_robot in status["poses"].items():
        name = name_of(robot)
        odometry = status.get("odometry") if robot == status["robot"] else None
        if odometry is None:
            yield map_frame(name), base_frame(name), SE2(*T_map_robot)
        else:
            yield map_frame(name), f"{name}/odom", SE2(*odometry["T_map_odom"])
            yield f"{name}/odom", base_frame(name), SE2(*odometry["T_odom_robot"])
