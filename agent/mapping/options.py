"""What can be set about mapping.  Every default is a measured decision; tests/bench/mapping.py reproduces the figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from agent.mapping.motion import MotionNoise
from protocol.geometry import SE2


@dataclass(frozen=True, slots=True)
class MappingOptions:
    """How a robot draws its map."""

    resolution_m: float = 0.05  # side of a cell; the likelihood field's kernel is tuned for it
    particles: int = 30  # a third to twice as many, as they spread; 10 broke one building in four, 100 cost twice the time
    matching_range_m: float = 25.0  # longer beams are cut: at 80 m the field of one particle is ten times as large
    T_base_laser: SE2 = SE2(0.0, 0.0, 0.0)  # where the LIDAR sits on the robot
    keyframe_distance_m: float = 0.3  # a scan enters the map when the robot moved this far ...
    keyframe_angle_rad: float = math.radians(12)  # ... or turned this far ...
    keyframe_interval_s: float = 5.0  # ... or after this long, so that people who walked by fade
    max_speed_m_s: float = 3.0  # faster odometry is a reset or a jump, never motion
    max_turn_rad_s: float = 6.0
    motion_noise: MotionNoise = field(default_factory=MotionNoise)
    occupied_above: float = 0.7  # the paper's thresholds; unknown between
    free_below: float = 0.3
