"""The feature maps that the page draws: extracted when somebody looks, and not more often than a person can see."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from agent.features.extraction import extract_features
from protocol.features import FeatureMap
from protocol.grid import OccupancyGrid

REFRESH_S = 3.0  # a growing map has a new version every second, and features cost tens of milliseconds
MAX_MAPS = 64


class DrawnFeatures:
    """Keeps the features of a map's version; several viewers cost no more than one."""

    def __init__(self, grid: Callable[[str], tuple[str, OccupancyGrid] | None]) -> None:
        self._grid = grid
        self._lock = threading.Lock()
        self._kept: dict[str, tuple[str, float, FeatureMap]] = {}  # map -> version, when, features

    def of(self, name: str) -> FeatureMap | None:
        """None when there is no such map."""
        found = self._grid(name)
        if found is None:
            return None
        version, grid = found
        with self._lock:
            kept = self._kept.get(name)
            if kept is None or (kept[0] != version and time.monotonic() - kept[1] > REFRESH_S):
                if len(self._kept) >= MAX_MAPS:
                    self._kept.clear()
                kept = self._kept[name] = (version, time.monotonic(), extract_features(grid))
            return kept[2]
