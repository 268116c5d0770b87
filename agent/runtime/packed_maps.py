"""A map as JSON values, for the control socket."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

from protocol.geometry import SE2
from protocol.grid import OccupancyGrid
from protocol.tiles import MAX_MAP_CELLS, pack_cells, unpack_cells


def packed_map(version: str, grid: OccupancyGrid) -> dict[str, Any]:
    """What `unpacked_map` reads."""
    return {
        "version": version,
        "height": grid.height,
        "width": grid.width,
        "resolution_m": grid.resolution_m,
        "origin": [grid.origin.x_m, grid.origin.y_m, grid.origin.theta_rad],
        "cells": base64.b64encode(pack_cells(grid.cells)).decode(),
    }


def unpacked_map(packed: Mapping[str, Any]) -> OccupancyGrid:
    cells = unpack_cells(base64.b64decode(packed["cells"]), packed["height"], packed["width"], MAX_MAP_CELLS)
    return OccupancyGrid(cells, packed["resolution_m"], SE2(*packed["origin"]))
