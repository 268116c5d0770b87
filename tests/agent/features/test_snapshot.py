"""A snapshot, and the snapshot of the same map a little later."""

from __future__ import annotations

import time

import numpy as np
import pytest

from agent.features.field import MatchField
from agent.features.snapshot import MapSnapshot
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.harness.floorplans import office

GRID = office(seed=3).mapped(SE2(1.0, 2.0, 0.4), noise_m=0.02, seed=1)


def same_walls(a: MapSnapshot, b: MapSnapshot) -> bool:
    return (
        np.array_equal(a.walls.cells_rc, b.walls.cells_rc)
        and np.allclose(a.walls.positions_m, b.walls.positions_m, atol=1e-4)
        and np.allclose(a.walls.normals, b.walls.normals, atol=1e-5)
        and np.allclose(a.walls.linearity, b.walls.linearity, atol=1e-5)
    )


def with_a_box(grid: OccupancyGrid, row: int, col: int) -> OccupancyGrid:
    cells = grid.cells.copy()
    cells[row : row + 8, col : col + 8] = FREE
    cells[row + 2 : row + 6, col + 2 : col + 6] = OCCUPIED
    return OccupancyGrid(cells, grid.resolution_m, grid.origin)


@pytest.mark.parametrize("seed", range(6))
def test_an_updated_snapshot_equals_a_fresh_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = MapSnapshot.of(GRID)
    assert len(before.walls)
    changed = with_a_box(GRID, int(rng.integers(GRID.height - 8)), int(rng.integers(GRID.width - 8)))
    assert same_walls(before.updated(changed), MapSnapshot.of(changed))


def everything(snapshot: MapSnapshot) -> dict[str, np.ndarray]:
    """All that matching keeps of a map, by name."""
    kept = {name: getattr(snapshot.field, name) for name in ("fine", "coarse", "nearest", "distance_m")}
    kept |= {name: getattr(snapshot.features, name) for name in ("lines", "circles", "arcs", "curves")}
    share = np.array(snapshot.field.wall_share)
    return kept | {"share": share, "signatures": snapshot.signatures.values, "corners": snapshot.corners.positions_m}


def test_everything_that_follows_from_updates_is_as_if_made_afresh() -> None:
    later = MapSnapshot.of(GRID)
    everything(later)
    changed = GRID
    for row, col in ((0, 0), (40, 60), (41, 63), (GRID.height - 8, 30), (70, GRID.width - 8)):
        changed = with_a_box(changed, row, col)
        later, fresh = later.updated(changed), everything(MapSnapshot.of(changed))
        for name, value in everything(later).items():
            assert np.array_equal(value, fresh[name]), (name, row, col)


def test_a_field_is_made_again_only_near_a_change(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = OccupancyGrid(np.tile(GRID.cells, (3, 3)), GRID.resolution_m)
    before = MapSnapshot.of(wide)
    everything(before)
    made: list[int] = []
    real = MatchField.of
    monkeypatch.setattr(MatchField, "of", lambda grid, walls: made.append(grid.free.size) or real(grid, walls))
    assert before.updated(with_a_box(wide, 100, 200)).field.fine.shape == before.field.fine.shape
    assert len(made) == 1
    assert made[0] < 0.1 * wide.cells.size
    assert before.updated(wide).field is before.field


def test_a_map_whose_origin_moved_keeps_its_wall_points() -> None:
    before = MapSnapshot.of(GRID)
    assert len(before.walls)
    cells = np.pad(GRID.cells, ((7, 2), (13, 0)), constant_values=UNKNOWN)
    grown = OccupancyGrid(cells, GRID.resolution_m, GRID.origin @ SE2(-1.3, -0.7, 0.0))
    assert same_walls(before.updated(grown), MapSnapshot.of(grown))


def test_a_map_on_another_lattice_is_made_afresh() -> None:
    before = MapSnapshot.of(GRID)
    assert len(before.walls)
    moved = OccupancyGrid(GRID.cells, GRID.resolution_m, GRID.origin @ SE2(0.03, 0.0, 0.01))
    assert same_walls(before.updated(moved), MapSnapshot.of(moved))


def test_nothing_known_has_no_features() -> None:
    for cells in (np.full((1, 1), UNKNOWN), np.full((50, 40), UNKNOWN), np.full((1, 1), OCCUPIED), np.full((30, 30), FREE)):
        snapshot = MapSnapshot.of(OccupancyGrid(cells.astype(np.int8), 0.1))
        assert len(snapshot.walls) == len(snapshot.lines) == len(snapshot.corners) == len(snapshot.signatures) == 0


@pytest.mark.parametrize("resolution_m", [0.02, 0.05, 0.07, 0.1, 0.2])
def test_lines_are_those_of_the_plan_at_any_resolution(resolution_m: float) -> None:
    plan = office(seed=3)
    snapshot = MapSnapshot.of(plan.mapped(SE2(0.0, 0.0, 0.0), resolution_m))
    longest = snapshot.lines.angles_rad[:6]
    off_axis = np.abs(np.remainder(longest + np.pi / 4, np.pi / 2) - np.pi / 4)
    assert np.degrees(off_axis).max() < 1.0


def test_a_checkerboard_takes_bounded_time() -> None:
    board = (np.indices((1500, 1500)).sum(axis=0) % 2 * OCCUPIED).astype(np.int8)
    started = time.process_time()
    snapshot = MapSnapshot.of(OccupancyGrid(board, 0.1))
    assert len(snapshot.walls) <= 60_000
    assert len(snapshot.lines) <= 2000
    assert len(snapshot.signatures) <= 1600
    assert time.process_time() - started < 5.0
