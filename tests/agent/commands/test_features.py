"""`mapquilt features`: the table a person reads, the object a program reads, the picture."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from agent.view.sheet import GAP
from protocol.features import ARC_COLUMNS, CIRCLE_COLUMNS, CURVE_COLUMNS, LINE_COLUMNS
from tests.agent.commands.conftest import Run, floor_plan


def test_the_table_tells_the_walls(run: Run, office: Path) -> None:
    ended = run("features", office)
    assert (ended.code, ended.err) == (0, "")
    head = re.match(
        r"office\.yaml: 20\.0 x 12\.0 m, cells of 5 cm: (\d+) lines, (\d+) circles, (\d+) arcs, (\d+) curves\n", ended.out
    )
    assert head
    assert int(head[2]) + int(head[3]) >= 1  # the pillar
    rows = [line.split("  ") for line in ended.out.splitlines() if re.match(r"\s+\d+  ", line)]
    assert len(rows) == int(head[1])


def test_json_has_every_column_in_the_map_frame(run: Run, office: Path) -> None:
    found = json.loads(run("features", office, "--json").out)
    assert list(found) == ["lines", "circles", "arcs", "curves"]
    for kind, columns in zip(found, (LINE_COLUMNS, CIRCLE_COLUMNS, ARC_COLUMNS, CURVE_COLUMNS), strict=True):
        assert all(tuple(feature) == columns for feature in found[kind])
    longest = max(found["lines"], key=lambda line: line["length_m"])
    assert longest["length_m"] == pytest.approx(19.5, abs=0.7)
    assert abs(math.sin(longest["normal_rad"])) == pytest.approx(1.0, abs=0.01)
    middle = floor_plan().points_of([(170, 330)])[0]
    round_ones = [(one["x_m"], one["y_m"], one["radius_m"]) for one in found["circles"] + found["arcs"]]
    assert any(one == pytest.approx((*middle, 0.95), abs=0.12) for one in round_ones)


def test_the_method_of_the_paper_has_its_own_table(run: Run, office: Path) -> None:
    found = json.loads(run("features", office, "--json", "--method", "paper").out)
    assert list(found) == ["lines", "circles", "curves"]
    assert {tuple(line) for line in found["lines"]} == {("x_m", "y_m", "size_m", "orientation_rad")}
    assert run("features", office, "--method", "paper").out.splitlines()[2].split() == [
        "line",
        "length",
        "m",
        "centre",
        "x,",
        "y",
        "m",
        "slope",
        "deg",
    ]


@pytest.mark.parametrize("method", ["hybrid", "paper"])
def test_the_picture_shows_lines_where_walls_are(method: str, run: Run, office: Path, tmp_path: Path) -> None:
    ended = run("features", office, "-o", tmp_path / "new" / "figure.png", "--method", method)
    assert ended.err == f"wrote {tmp_path}/new/figure.png\n"
    picture = cv2.imread(str(tmp_path / "new" / "figure.png")).astype(int)
    drawn = picture[-GAP - 931 : -GAP, GAP:-GAP]  # below the legend
    assert drawn.shape == (931, 1552, 3)
    blue = (drawn[:, :, 0] > 150) & (drawn[:, :, 2] < 60)
    wall = cv2.resize((floor_plan().cells[::-1] == 100).astype(np.uint8), (1552, 931)) > 0
    near_wall = cv2.dilate(wall.astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
    assert blue.sum() > 5000
    assert (blue & near_wall).sum() > 0.98 * blue.sum()


def test_a_map_that_cannot_be_read_or_a_picture_that_cannot_be_written_is_told(run: Run, office: Path, tmp_path: Path) -> None:
    ended = run("features", tmp_path / "none.yaml")
    assert (ended.code, ended.err) == (4, f"mapquilt: {tmp_path}/none.yaml: No such file or directory\n")
    ended = run("features", office, "-o", office / "x.png")
    assert ended.code == 3
    assert "cannot be written" in ended.err


def test_an_empty_map_has_an_empty_table(run: Run, office: Path) -> None:
    office.with_suffix(".pgm").write_bytes(b"P5 3 3 255\n" + bytes([205] * 9))
    for method in ("hybrid", "paper"):
        ended = run("features", office, "--method", method)
        assert ended.code == 0
        assert "0 lines" in ended.out
