"""`mapquilt features MAP`: the feature map of a map, as a table (the paper's Table 1) and as a picture (its Figure 1)."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from agent.commands.files import loaded_map, spare_inputs, written_file
from agent.exits import OK
from agent.features.extraction import extract_features
from agent.features.paper import PAPER_COLUMNS, PaperFeatures, paper_features
from agent.image_files import encode_png
from agent.view.features_picture import features_picture
from protocol.features import ARC_COLUMNS, CIRCLE_COLUMNS, CURVE_COLUMNS, LINE_COLUMNS, FeatureMap, FeatureTable
from protocol.grid import OccupancyGrid

EXAMPLES = """\
  mapquilt features office.yaml                   lines, circles, arcs and curves, with their uncertainty
  mapquilt features office.yaml -o features.png   ... and drawn over the map
  mapquilt features office.yaml --method paper    as the paper finds them: Hough lines, Hough circles, what remains
  mapquilt features office.yaml --json            for programs: metres and radians in the map frame
"""

COLUMNS = {"lines": LINE_COLUMNS, "circles": CIRCLE_COLUMNS, "arcs": ARC_COLUMNS, "curves": CURVE_COLUMNS}
Rows = Iterator[Sequence[str]]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", type=Path, metavar="MAP.yaml", help="a nav2 map")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.png", help="draw them over the map")
    parser.add_argument("--method", choices=("hybrid", "paper"), default="hybrid", help="how they are found (default: hybrid)")
    parser.add_argument("--json", action="store_true", help="one JSON object")


def run(args: argparse.Namespace) -> int:
    if args.output is not None:
        spare_inputs([args.output], [args.map])
    grid = loaded_map(args.map)
    features: FeatureMap | PaperFeatures = paper_features(grid) if args.method == "paper" else extract_features(grid)
    if args.output is not None:
        drawn = features if isinstance(features, FeatureMap) else as_feature_map(features)
        written_file(args.output, encode_png(features_picture(grid, drawn)))
        if not args.quiet:
            print(f"wrote {args.output}", file=sys.stderr)
    print(json.dumps(as_json(features)) if args.json else as_text(args.map.name, grid, features))
    return OK


def as_json(features: FeatureMap | PaperFeatures) -> dict[str, list[dict[str, float]]]:
    """Kind -> features, by column name, in the map frame."""
    found = {}
    for kind, columns in COLUMNS.items():
        table = getattr(features, kind, None)
        if table is not None:
            names = columns if isinstance(features, FeatureMap) else PAPER_COLUMNS
            found[kind] = [{n: round(float(v), 5) for n, v in zip(names, row, strict=True)} for row in table]
    return found


def as_text(name: str, grid: OccupancyGrid, features: FeatureMap | PaperFeatures) -> str:
    """The table, one block a kind."""
    width_m, height_m = grid.width * grid.resolution_m, grid.height * grid.resolution_m
    kinds = {kind: getattr(features, kind) for kind in COLUMNS if hasattr(features, kind)}
    counts = ", ".join(f"{len(table)} {kind}" for kind, table in kinds.items())
    lines = [f"{name}: {width_m:.1f} x {height_m:.1f} m, cells of {grid.resolution_m * 100:.3g} cm: {counts}"]
    for kind, table in kinds.items():
        if len(table):
            rows = _paper_rows(kind, table) if isinstance(features, PaperFeatures) else _ROWS[kind](table)
            lines += ["", *_aligned(list(rows))]
    return "\n".join(lines)


def as_feature_map(features: PaperFeatures) -> FeatureMap:
    """The paper's features for the pen: a line gets a side, although the paper gives it none."""
    lines = [[x, y, slope + math.pi / 2, length, 0.0, 0.0] for x, y, length, slope in features.lines]
    circles = [[x, y, radius, 0.0] for x, y, radius, _ in features.circles]
    curves = [[x, y, slope, size, 0.0] for x, y, size, slope in features.curves]
    return FeatureMap(_table(lines, 6), _table(circles, 4), FeatureMap().arcs, _table(curves, 5))


def _table(rows: list[list[float]], columns: int) -> FeatureTable:
    return np.array(rows, np.float32).reshape(-1, columns)


def _line_rows(table: FeatureTable) -> Rows:
    yield "line", "slope deg", "length m", "centre x, y m", "free side deg", "+- deg", "+- cm"
    for number, (x, y, normal, length, sigma_theta, sigma_rho) in enumerate(table.tolist(), 1):
        slope = (math.degrees(normal) + 90.0) % 180.0
        angle = f"{math.degrees(normal):.1f}"
        yield str(number), f"{slope:.1f}", f"{length:.2f}", _point(x, y), angle, _deg(sigma_theta), _cm(sigma_rho)


def _circle_rows(table: FeatureTable) -> Rows:
    yield "circle", "radius m", "centre x, y m", "+- cm"
    for number, (x, y, radius, sigma) in enumerate(table.tolist(), 1):
        yield f"o{number}", f"{radius:.2f}", _point(x, y), _cm(sigma)


def _arc_rows(table: FeatureTable) -> Rows:
    yield "arc", "radius m", "centre x, y m", "from deg", "span deg", "+- cm"
    for number, (x, y, radius, start, span, sigma) in enumerate(table.tolist(), 1):
        yield f"a{number}", f"{radius:.2f}", _point(x, y), f"{math.degrees(start):.1f}", f"{math.degrees(span):.1f}", _cm(sigma)


def _curve_rows(table: FeatureTable) -> Rows:
    yield "curve", "size m", "centre of mass x, y m", "orientation deg", "+- cm"
    for number, (x, y, orientation, size, sigma) in enumerate(table.tolist(), 1):
        yield f"c{number}", f"{size:.2f}", _point(x, y), f"{math.degrees(orientation):.1f}", _cm(sigma)


_ROWS = {"lines": _line_rows, "circles": _circle_rows, "arcs": _arc_rows, "curves": _curve_rows}


def _paper_rows(kind: str, table: FeatureTable) -> Rows:
    heads = {"lines": ("line", "slope deg", "length m"), "circles": ("circle", "", "radius m")}
    name, slope_head, size_head = heads.get(kind, ("curve", "slope deg", "size m"))
    yield name, size_head, "centre x, y m", slope_head
    for number, (x, y, size, slope) in enumerate(table.tolist(), 1):
        yield str(number), f"{size:.2f}", _point(x, y), f"{math.degrees(slope):.1f}" if slope_head else ""


def _point(x: float, y: float) -> str:
    return f"{x:.2f}, {y:.2f}"


def _deg(sigma_rad: float) -> str:
    return f"{math.degrees(sigma_rad):.2f}"


def _cm(sigma_m: float) -> str:
    return f"{sigma_m * 100:.1f}"


def _aligned(rows: list[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
