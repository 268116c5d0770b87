"""What a map costs on the wire: the first time, and at every update, against sending a PNG of it.

    .venv/bin/python -m tests.bench.wire_bytes [--logs intel freiburg-079 acapulco] [--every 10] [--json FILE]

A recording is drawn at its reference poses at 5 cm; after every `--every` scans the map is published.  Counted are the exact
encoded messages of this protocol: announcement, coarse map and all cells for the first merge; changed cells for each update, and
the features again whenever the map has grown by a tenth.  A PNG is the whole map, losslessly, at the highest compression level.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from agent.features.snapshot import MapSnapshot
from agent.fleet.own_map import COARSE_M, OwnMap, coarsened
from hw.carmen import read_recording
from protocol.codec import encode
from protocol.features import FeatureMap
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from protocol.messages import CoarseMap, FineTiles
from protocol.tiles import TileDelta, TileMap
from tests.bench.recordings import SHARED
from tests.bench.tables import markdown, write_json

CELL_M, RANGE_M = 0.05, 25.0


@dataclass(frozen=True, slots=True)
class Cost:
    """One recording."""

    log: str
    updates: int
    features_bytes: int  # of the finished map: the announcement
    coarse_bytes: int
    fine_bytes: int
    png_bytes: int
    update_bytes: float  # mean
    update_median_bytes: float
    png_update_bytes: float  # mean PNG of the whole map at the same moments
    ratio: float  # steady state: all updates against all PNGs


class Sketch:
    """A map drawn at known poses: beams clear cells, ends fill them."""

    def __init__(self, corner_m: np.ndarray, size_m: np.ndarray) -> None:
        shape = np.ceil(size_m[::-1] / CELL_M).astype(int) + 1
        self.corner_m = corner_m
        self.free, self.hits = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def draw(self, T: SE2, ranges_m: np.ndarray, angles_rad: np.ndarray) -> None:
        reach = np.clip(np.nan_to_num(ranges_m, nan=0.0, posinf=0.0), 0.0, RANGE_M)
        ends = T.apply(np.stack([reach * np.cos(angles_rad), reach * np.sin(angles_rad)], axis=1))
        fan = np.concatenate([[[T.x_m, T.y_m]], ends])
        pixels = np.round((fan - self.corner_m) / CELL_M).astype(np.int32)
        swept = np.zeros(self.free.shape, np.uint8)
        cv2.fillPoly(swept, [pixels], 1)
        hit = pixels[1:][(reach > 0.1) & (reach < RANGE_M)]
        hit = hit[(hit >= 0).all(axis=1) & (hit[:, 0] < swept.shape[1]) & (hit[:, 1] < swept.shape[0])]
        swept[hit[:, 1], hit[:, 0]] = 0
        self.free += swept
        self.hits[hit[:, 1], hit[:, 0]] += 1.0

    def grid(self) -> OccupancyGrid:
        total = self.free + self.hits
        with np.errstate(invalid="ignore", divide="ignore"):
            share = self.hits / total
        cells = np.where(total == 0, UNKNOWN, np.where(share > 0.3, OCCUPIED, FREE)).astype(np.int8)
        corner = np.round(self.corner_m / CELL_M) * CELL_M
        return OccupancyGrid(cells, CELL_M, SE2(float(corner[0]), float(corner[1]), 0.0))


def png_bytes(grid: OccupancyGrid) -> int:
    image = np.where(grid.cells == OCCUPIED, 0, np.where(grid.cells == FREE, 254, 205)).astype(np.uint8)
    return len(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1])


def measure(log: str, every: int) -> Cost:
    scans = read_recording(SHARED / "data" / "carmen" / f"{log}.log.gz").scans
    places = np.array([[scan.T_map_laser.x_m, scan.T_map_laser.y_m] for scan in scans])
    low, high = places.min(axis=0) - RANGE_M - 1, places.max(axis=0) + RANGE_M + 1
    sketch, own, previous = Sketch(low, high - low), OwnMap("r1", 1, is_frozen=False), None
    updates, pngs, announced_m2 = [], [], 0.0
    grid = OccupancyGrid.empty(CELL_M)
    for i, scan in enumerate(scans):
        sketch.draw(scan.T_map_laser, scan.ranges_m, scan.angles_rad)
        if i % every or i == 0:
            continue
        grid = sketch.grid().cropped()
        tiles = TileMap.of(grid, previous)
        if previous is not None and tiles.digest != previous.digest:
            own.publish(grid, FeatureMap(), 1)
            assert own.version is not None and own.announcement is not None
            delta = TileDelta.between(previous, tiles)
            cost = len(encode(FineTiles("r1", 1, own.version, delta)))
            if own.known_area_m2 > 1.1 * announced_m2:  # the features travel again when the map has grown
                announced_m2 = own.known_area_m2
                features = replace(own.announcement, features=MapSnapshot.of(grid).features)
                cost += len(encode(features))
            updates.append(cost)
            pngs.append(png_bytes(grid))
        previous = tiles
    snapshot = MapSnapshot.of(grid)
    own.publish(grid, snapshot.features, 2)
    assert own.announcement is not None and own.version is not None and previous is not None
    whole = encode(FineTiles("r1", 1, own.version, TileDelta.between(None, previous)))
    announced = len(encode(own.announcement))
    coarse = encode(CoarseMap("r1", 1, own.version, coarsened(grid, COARSE_M)))
    return Cost(
        log,
        len(updates),
        announced,
        len(coarse),
        len(whole),
        png_bytes(grid),
        statistics.fmean(updates),
        statistics.median(updates),
        statistics.fmean(pngs),
        sum(updates) / sum(pngs),
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", nargs="+", default=["intel", "freiburg-079", "acapulco"])
    parser.add_argument("--every", type=int, default=10, help="scans between two publications")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if not (SHARED / "data").is_dir():
        print(f"no recordings at {SHARED}/data: set MAPQUILT_SHARED", file=sys.stderr)
        return 2
    costs = [measure(log, args.every) for log in args.logs]
    write_json(args.json, [asdict(cost) for cost in costs])
    rows = [
        {
            "recording": f"{c.log} ({c.updates} updates)",
            "features": f"{c.features_bytes:,} B",
            "coarse": f"{c.coarse_bytes:,} B",
            "all cells": f"{c.fine_bytes:,} B",
            "PNG": f"{c.png_bytes:,} B",
            "an update: mean, median": f"{c.update_bytes:,.0f}, {c.update_median_bytes:,.0f} B",
            "PNG then": f"{c.png_update_bytes:,.0f} B",
            "updates cost": f"1/{1 / c.ratio:.1f}",
        }
        for c in costs
    ]
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
