"""The grid: thresholds, one vote a scan, growth without moving, and drawing again when the past changed."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from agent.mapping.log_odds import TILE_CELLS, LogOddsGrid
from agent.mapping.motion import OdometryTrack
from agent.mapping.options import MappingOptions
from agent.mapping.redrawing import SCANS_A_CALL, Drawing
from agent.mapping.scan_points import scan_points
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN
from tests.agent.mapping.worlds import ROOMS, rounds, scan_at

OPTIONS = MappingOptions()


def beam(grid: LogOddsGrid, x_m: float, clears: bool = True, is_hit: bool = True) -> None:
    grid.add((0.025, 0.025), np.array([[x_m, 0.025]]), np.array([is_hit]), clears)


def cell(grid: LogOddsGrid, x_m: float) -> int:
    return int(grid.trinary().values_at(np.array([[x_m, 0.025]]))[0])


def test_one_end_is_occupied_three_passes_are_free_and_between_is_unknown() -> None:
    grid = LogOddsGrid(0.05)
    beam(grid, 2.02)
    assert (cell(grid, 2.02), cell(grid, 1.0), cell(grid, 3.0)) == (OCCUPIED, UNKNOWN, UNKNOWN)
    beam(grid, 2.02)
    beam(grid, 2.02)
    assert cell(grid, 1.0) == FREE


def test_what_beams_pass_again_and_again_fades() -> None:
    grid = LogOddsGrid(0.05)
    beam(grid, 1.02)
    for _ in range(5):
        beam(grid, 3.02)
    assert cell(grid, 1.02) == FREE


def test_a_cut_beam_ends_in_nothing() -> None:
    grid = LogOddsGrid(0.05)
    for _ in range(3):
        beam(grid, 2.02, is_hit=False)
    assert cell(grid, 2.02) != OCCUPIED
    assert cell(grid, 1.0) == FREE


def test_growth_in_every_direction_moves_no_cell() -> None:
    grid = LogOddsGrid(0.05)
    beam(grid, 2.02)
    grid.add((0.0, 0.0), np.array([[-20.0, -15.0], [18.0, 30.0]]), np.array([True, True]), clears=True)
    assert cell(grid, 2.02) == OCCUPIED
    assert grid.trinary().values_at(np.array([[-20.0, -15.0], [18.0, 30.0]])).tolist() == [OCCUPIED, OCCUPIED]


def test_only_tiles_that_were_touched_are_reported() -> None:
    grid = LogOddsGrid(0.05)
    beam(grid, 10.0)
    revision = grid.revision
    beam(grid, 2.0)
    rows, cols = np.nonzero(grid.tile_revisions > revision)
    assert set(zip((rows + grid.first_tile[0]).tolist(), (cols + grid.first_tile[1]).tolist(), strict=True)) == {(0, 0)}
    assert 2.0 / 0.05 < TILE_CELLS < 10.0 / 0.05


def test_a_changed_past_is_drawn_again_to_the_very_cells_of_a_fresh_drawing() -> None:
    rng = np.random.default_rng(0)
    scans = [
        scan_points(scan_at(ROOMS, pose, s, rng), OdometryTrack(3.0, 6.0), OPTIONS)
        for s, pose in rounds(2.5 * SCANS_A_CALL / 5.0)
    ]
    true = [pose for _, pose in rounds(2.5 * SCANS_A_CALL / 5.0)]
    path = np.array([[p.x_m, p.y_m, p.theta_rad] for p in true])
    wrong = path + np.linspace(0.0, 0.3, len(path))[:, None]
    drawing, expected = Drawing(OPTIONS), Drawing(OPTIONS)
    for points, a, b in zip(scans, wrong, path, strict=True):
        drawing.add(points, a)
        expected.add(points, b)
    for _ in range(4):
        drawing.follow(path)
    assert drawing.redrawn == 1
    assert np.array_equal(drawing.poses, path)
    ours, theirs = drawing.grid.trinary().cropped(), expected.grid.trinary().cropped()
    assert np.array_equal(ours.cells, theirs.cells)
    assert ours.origin == theirs.origin


def test_small_changes_of_the_past_are_left_alone() -> None:
    drawing = Drawing(OPTIONS)
    points = scan_points(scan_at(ROOMS, SE2(0.0, 0.0, 0.0), 0.0, np.random.default_rng(0)), OdometryTrack(3.0, 6.0), OPTIONS)
    drawing.add(points, np.zeros(3))
    drawing.follow(np.full((1, 3), 0.005))
    assert drawing.fresh is None


def test_one_hit_is_a_wall_only_where_nothing_ever_passed() -> None:
    """Where a beam passed, in whatever order, it takes hits from two keyframes; a wall seen once appears at once."""
    for scans in [scans for n in range(2, 6) for scans in product((2.02, 3.02), repeat=n)]:
        grid = LogOddsGrid(0.05)
        for x_m in scans:
            beam(grid, x_m)
        hits, passes = scans.count(2.02), scans.count(3.02)
        if hits < 2 and passes > 0:
            assert cell(grid, 2.02) != OCCUPIED, scans
        if passes == 0 or hits > 2 * passes:
            assert cell(grid, 2.02) == OCCUPIED, scans


def test_a_person_who_walks_through_the_room_is_not_on_the_map() -> None:
    rng, grid = np.random.default_rng(0), LogOddsGrid(0.05)
    walk = [SE2(x, 0.9 - 0.1 * x, 0.0) for x in np.arange(-3.5, 2.0, 0.35)]
    for k, person in enumerate([*walk, None, None]):
        legs = np.empty((0, 4)) if person is None else legs_at(person)
        robot = SE2(-3.0 + 0.1 * k, -2.0, 0.3 * k)
        points = scan_points(scan_at(np.vstack([ROOMS, legs]), robot, 5.0 * k, rng, beams=720), OdometryTrack(3.0, 6.0), OPTIONS)
        grid.add((robot.x_m, robot.y_m), robot.apply(points.points_m), points.is_hit, clears=True)
    drawn = grid.trinary()
    occupied_m = drawn.points_of(np.argwhere(drawn.cells == OCCUPIED))
    assert len(occupied_m) > 300
    assert distance_to(ROOMS, occupied_m).max() < 0.12


def legs_at(person: SE2) -> NDArray[np.float64]:
    """A box of 0.3 m as four segments."""
    x, y, r = person.x_m, person.y_m, 0.15
    corners = np.array([[x - r, y - r], [x + r, y - r], [x + r, y + r], [x - r, y + r]])
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def distance_to(world: NDArray[np.float64], points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) metres from each point to the nearest segment."""
    a, way = world[:, :2], world[:, 2:] - world[:, :2]
    along = np.clip(((points_m[:, None] - a) * way).sum(axis=2) / (way**2).sum(axis=1), 0.0, 1.0)
    nearest = a + along[..., None] * way
    return np.asarray(np.hypot(*(points_m[:, None] - nearest).transpose(2, 0, 1)).min(axis=1))
