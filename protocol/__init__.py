"""The words robots share: types, their exact bytes, and the table of channels.  No I/O."""

from __future__ import annotations

from protocol.features import FeatureMap
from protocol.geometry import SE2, Pose2D, wrap_angle
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

PROTOCOL_VERSION = 1

__all__ = ["FREE", "OCCUPIED", "PROTOCOL_VERSION", "SE2", "UNKNOWN", "FeatureMap", "OccupancyGrid", "Pose2D", "wrap_angle"]
