"""`mapquilt merge`: what it prints, writes and returns."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from agent import cli
from agent.map_files import load_map, save_map
from agent.view.group_picture import SEVERAL
from protocol.geometry import SE2, wrap_angle
from protocol.grid import FREE, OCCUPIED, OccupancyGrid
from tests.harness.floorplans import office

PLAN = office(0)
T_A, T_B, T_C = SE2(3.0, -2.0, 0.3), SE2(-10.0, 5.0, 2.5), SE2(0.0, 0.0, -1.2)


@pytest.fixture
def maps(tmp_path: Path) -> dict[str, Path]:
    """Three overlapping parts of one building and a part of another; b's file speaks of a turned frame far away."""
    far = SE2(100.0, -50.0, 0.7)
    b = PLAN.mapped(T_B, 0.05, (0.3 * PLAN.width_m, 0.8 * PLAN.width_m))
    grids = {
        "a": PLAN.mapped(T_A, 0.05, (-1, 0.6 * PLAN.width_m)),
        "b": OccupancyGrid(b.cells, b.resolution_m, far @ b.origin),
        "c": PLAN.mapped(T_C, 0.1, (0.5 * PLAN.width_m, 1e3)),
        "other": office(9).mapped(T_C, 0.05),
    }
    return {name: save_map(grid, tmp_path / name)[0] for name, grid in grids.items()}


def merge(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict]:
    code = cli.main(["merge", *map(str, words), "--json"])
    out = capsys.readouterr().out
    return code, json.loads(out) if out else {}


def as_se2(answer: dict) -> SE2:
    return SE2(answer["x"], answer["y"], answer["theta"])


def assert_close(T: SE2, truth: SE2, at: tuple[float, float] = (0.0, 0.0), within_m: float = 0.05) -> None:
    assert math.hypot(*(T.apply([at]) - truth.apply([at]))[0]) < within_m
    assert abs(wrap_angle(T.theta_rad - truth.theta_rad)) < 0.006


def test_two_maps_that_fit(maps, capsys):
    code, answer = merge(capsys, maps["a"], maps["b"])
    assert code == 0
    assert answer["accepted"] is True
    assert answer["status"] == "merged"
    assert answer["match_factor"] > 0.85
    assert answer["score"] > answer["runner_up_score"]
    assert np.array(answer["covariance"]).shape == (3, 3)
    assert answer["overlap_m2"] > 50


def test_x_y_theta_are_between_the_lower_left_corners_and_map_frame_between_the_files_frames(maps, capsys):
    _, answer = merge(capsys, maps["a"], maps["b"])
    a, b = load_map(maps["a"]), load_map(maps["b"])
    T_files = T_A @ T_B.inverse() @ SE2(100.0, -50.0, 0.7).inverse()  # from b's file frame, far away, to a's
    assert_close(as_se2(answer["map_frame"]), T_files, at=(b.origin.x_m, b.origin.y_m))
    assert_close(as_se2(answer), a.origin.inverse() @ T_files @ b.origin)


def test_different_buildings_do_not_merge(maps, tmp_path, capsys):
    code, answer = merge(capsys, maps["a"], maps["other"], "-o", tmp_path / "both")
    assert code == 1
    assert answer["accepted"] is False
    assert answer["reason"]
    assert not (tmp_path / "both.yaml").exists()
    assert cv2.imread(str(tmp_path / "both.png")) is not None


def test_the_merged_map_lies_in_the_first_maps_frame_and_keeps_its_cells(maps, tmp_path, capsys):
    code, answer = merge(capsys, maps["a"], maps["b"], "-o", tmp_path / "out" / "both")
    both, a = load_map(tmp_path / "out" / "both.yaml"), load_map(maps["a"])
    known = np.argwhere(a.known())
    values, kept = both.values_at(a.points_of(known)), a.cells[tuple(known.T)]
    assert code == 0
    assert np.mean(values == kept) > 0.98
    assert both.known_area_m2() > 1.3 * a.known_area_m2()
    assert answer["consistency"] > 0.98
    assert both.resolution_m == 0.05
    assert both.origin.theta_rad == 0.0


def test_a_first_map_whose_frame_is_turned_is_written_upright(maps, tmp_path, capsys):
    code, _ = merge(capsys, maps["b"], maps["a"], "-o", tmp_path / "both")
    both, b = load_map(tmp_path / "both.yaml"), load_map(maps["b"])
    walls = b.points_of(np.argwhere(b.cells == OCCUPIED))
    assert code == 0
    assert both.origin.theta_rad == 0.0
    assert np.mean(both.values_at(walls) == OCCUPIED) > 0.8


def test_three_maps_of_two_resolutions_close_their_loop(maps, tmp_path, capsys):
    code, answer = merge(capsys, maps["a"], maps["b"], maps["c"], "-o", tmp_path / "all")
    assert code == 0
    assert [m["joined"] for m in answer["maps"]] == [True, True, True]
    assert len(answer["pairs"]) == 3
    a, c = load_map(maps["a"]), load_map(maps["c"])
    assert_close(as_se2(answer["maps"][2]), a.origin.inverse() @ T_A @ T_C.inverse() @ c.origin, within_m=0.15)
    assert load_map(tmp_path / "all.yaml").known_area_m2() == pytest.approx(PLAN.width_m * PLAN.height_m, rel=0.05)
    together = cv2.imread(str(tmp_path / "all.png"))
    assert int((together == SEVERAL).all(axis=2).sum()) > 10_000  # walls that lie on one another


def test_a_stranger_among_three_makes_the_answer_no_and_is_named(maps, capsys):
    code, answer = merge(capsys, maps["a"], maps["b"], maps["other"])
    assert code == 1
    assert answer["accepted"] is False
    assert [m["joined"] for m in answer["maps"]] == [True, True, False]
    assert (answer["status"], answer["reason"]) == ("no", "2 of 3 maps are one; not other.yaml")


@pytest.mark.parametrize("method", ["paper", "paper-guarded"])
def test_the_papers_methods_can_be_asked_for(maps, capsys, method):
    code, answer = merge(capsys, maps["a"], maps["b"], "--method", method)
    assert (code, answer["method"]) == (0, method)
    assert answer["candidates_tried"] > 100


def test_without_json_there_is_a_sentence(maps, capsys):
    assert cli.main(["merge", str(maps["a"]), str(maps["b"])]) == 0
    assert capsys.readouterr().out.startswith("merged: b.yaml lies on a.yaml at x ")


def test_a_file_that_is_no_map_is_exit_code_four(maps, tmp_path, capsys):
    bad = tmp_path / "bad.yaml"
    bad.write_text("image: nowhere.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    assert cli.main(["merge", str(maps["a"]), str(bad)]) == 4
    assert "bad.yaml" in capsys.readouterr().err
    assert cli.main(["merge", str(maps["a"]), str(tmp_path / "absent.yaml")]) == 4


@pytest.mark.parametrize("words", [["one"], ["a", "b", "--resolution", "0"], ["a", "b", "--resolution", "nan"]])
def test_a_wrong_command_line_is_exit_code_two(maps, words):
    assert cli.main(["merge", *[str(maps.get(word, word)) for word in words]]) == 2


def test_maps_without_a_wall_get_an_answer(tmp_path, capsys):
    nothing = save_map(OccupancyGrid(np.full((5, 5), FREE, np.int8), 0.05), tmp_path / "free")[0]
    code, answer = merge(capsys, nothing, nothing, "-o", tmp_path / "out")
    assert code == 1
    assert answer["x"] is None
    assert (tmp_path / "out.png").exists()


@pytest.mark.parametrize("command", ["merge {a} {b} -o {a}", "merge {a} {b} -o {stem}", "features {a} -o {image}",
    "localize {b} {a} -o {image}"])  # fmt: skip
def test_a_map_that_is_read_is_not_written_over(maps, tmp_path, capsys, command):
    a = save_map(load_map(maps["a"]), tmp_path / "mine")[0]
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    words = command.format(a=a, b=maps["b"], stem=a.with_suffix(""), image=a.with_suffix(".pgm")).split()
    assert cli.main(words) == 2
    assert "one of the maps that are read" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
