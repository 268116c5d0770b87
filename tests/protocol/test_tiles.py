"""Tiles: exact round trips, small differences, and bytes that lie."""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.errors import LocalProtocolError, RemoteProtocolError, TooLarge
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from protocol.tiles import MAX_GRID_CELLS, MAX_MAP_CELLS, TILE_BYTES, TileDelta, TileMap, inflate, pack_cells, unpack_cells
from tests.protocol.examples import small_grid

VALUES = np.array([UNKNOWN, FREE, OCCUPIED], np.int8)


def random_grid(seed: int, height: int, width: int, origin: SE2) -> OccupancyGrid:
    rng = np.random.default_rng(seed)
    return OccupancyGrid(rng.choice(VALUES, size=(height, width)), 0.05, origin)


@given(st.integers(0, 2**32 - 1), st.integers(1, 150), st.integers(1, 150))
@settings(max_examples=60, deadline=None)
def test_cells_come_back_from_packing(seed: int, height: int, width: int) -> None:
    cells = random_grid(seed, height, width, SE2.identity()).cells
    assert np.array_equal(unpack_cells(pack_cells(cells), height, width), cells)


@given(st.integers(0, 2**32 - 1), st.integers(1, 150), st.integers(1, 150), st.integers(-300, 300), st.integers(-300, 300))
@settings(max_examples=60, deadline=None)
def test_a_grid_comes_back_from_tiles_wherever_it_lies(seed: int, height: int, width: int, row: int, col: int) -> None:
    grid = random_grid(seed, height, width, SE2(col * 0.05, row * 0.05, 0.0))
    back, expected = TileMap.of(grid).grid(), grid.cropped()
    assert np.array_equal(back.cells, expected.cells)
    if grid.known().any():
        assert back.origin.distance_m(expected.origin) < 1e-9


def test_a_turned_or_shifted_grid_gets_a_lattice_of_its_own() -> None:
    grid = random_grid(1, 40, 50, SE2(0.013, 7.7, 1.1))
    back = TileMap.of(grid).grid()
    assert np.array_equal(back.cells, grid.cropped().cells)
    assert back.origin.distance_m(grid.cropped().origin) < 1e-9


def test_the_digest_does_not_depend_on_margins_or_on_the_way_there() -> None:
    grid = small_grid()
    padded = OccupancyGrid(np.pad(grid.cells, 70, constant_values=UNKNOWN), 0.1, grid.origin @ SE2(-7.0, -7.0, 0.0))
    assert TileMap.of(padded).digest == TileMap.of(grid).digest
    changed = OccupancyGrid(grid.cells.copy(), 0.1, grid.origin)
    changed.cells[5, 5] = OCCUPIED
    first = TileMap.of(grid)
    assert TileMap.of(changed, first).digest != first.digest
    assert TileMap.of(grid, TileMap.of(changed, first)).digest == first.digest


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_a_delta_turns_its_base_into_the_new_map(seed: int) -> None:
    rng = np.random.default_rng(seed)
    old = TileMap.of(random_grid(seed, 130, 100, SE2(-1.0, 0.5, 0.0)))
    cells = old.grid().cells.copy()
    r, c = rng.integers(0, 90), rng.integers(0, 60)
    cells[r : r + 30, c : c + 30] = rng.choice(VALUES)
    new = TileMap.of(OccupancyGrid(cells, 0.05, old.grid().origin), old)
    assert TileDelta.between(old, new).apply(old) == new
    assert TileDelta.between(None, new).apply(None) == new
    assert TileDelta.between(new, old).apply(new) == old


def test_a_few_changed_cells_cost_a_few_bytes() -> None:
    old = TileMap.of(random_grid(3, 640, 640, SE2.identity()))
    cells = old.grid().cells.copy()
    cells[100:103, 100:110] = OCCUPIED
    delta = TileDelta.between(old, TileMap.of(OccupancyGrid(cells, 0.05), old))
    assert len(delta.keys) == 1
    assert len(delta.payload) < 80


def test_a_tile_that_became_unknown_again_disappears() -> None:
    grid = random_grid(4, 64, 128, SE2.identity())
    old = TileMap.of(grid)
    cells = grid.cells.copy()
    cells[:, :64] = UNKNOWN
    new = TileMap.of(OccupancyGrid(cells, 0.05), old)
    assert set(new.tiles) == {(0, 1)}
    assert TileDelta.between(old, new).apply(old) == new


def test_a_delta_on_another_base_is_refused() -> None:
    a, b = TileMap.of(random_grid(1, 70, 70, SE2.identity())), TileMap.of(random_grid(2, 70, 70, SE2.identity()))
    delta = TileDelta.between(a, b)
    for base in (None, b):
        with pytest.raises(RemoteProtocolError, match="base"):
            delta.apply(base)


def test_a_delta_that_leads_elsewhere_than_it_says_is_refused() -> None:
    tiles = TileMap.of(small_grid())
    delta = TileDelta.between(None, tiles)
    with pytest.raises(RemoteProtocolError, match="announces"):
        replace(delta, digest=bytes(16)).apply(None)
    with pytest.raises(RemoteProtocolError, match="lattice"):
        replace(TileDelta.between(tiles, tiles), anchor=SE2(1.0, 0.0, 0.0)).apply(tiles)


@pytest.mark.parametrize("byte", [243, 255])
def test_a_byte_that_is_no_five_cells_is_refused(byte: int) -> None:
    delta = TileDelta.between(None, TileMap.of(small_grid()))
    bad = zlib.compress(bytes([byte]) * TILE_BYTES * len(delta.keys))
    with pytest.raises(RemoteProtocolError, match="five cells"):
        replace(delta, payload=bad).apply(None)


def test_cells_beyond_the_last_row_are_refused() -> None:
    with pytest.raises(RemoteProtocolError, match="last row"):
        unpack_cells(zlib.compress(bytes([242])), 3, 1)
    delta = TileDelta.between(None, TileMap.of(small_grid()))
    with pytest.raises(RemoteProtocolError, match="last row"):
        replace(delta, payload=zlib.compress(bytes([242]) * TILE_BYTES * len(delta.keys))).apply(None)


def test_inflating_gives_exactly_what_was_promised_or_nothing() -> None:
    good = zlib.compress(bytes(1000), 6)
    assert inflate(good, 1000) == bytes(1000)
    for data, size in ((good, 999), (good, 1001), (good[:-1], 1000), (good + b"x", 1000), (b"", 0), (b"junk", 4)):
        with pytest.raises(RemoteProtocolError):
            inflate(data, size)


def test_a_bomb_is_not_unpacked() -> None:
    bomb = zlib.compress(bytes(200_000_000), 9)
    with pytest.raises(RemoteProtocolError):
        inflate(bomb, 10_000)


@pytest.mark.parametrize(("height", "width"), [(0, 5), (5, 0), (-1, -1), (2**16, 2**16), (1, MAX_GRID_CELLS + 1)])
def test_impossible_sizes_are_refused_before_anything_is_allocated(height: int, width: int) -> None:
    with pytest.raises(TooLarge):
        unpack_cells(b"", height, width)


def test_a_grid_with_other_values_may_not_travel() -> None:
    with pytest.raises(LocalProtocolError):
        TileMap.of(OccupancyGrid(np.full((3, 3), 50, np.int8), 0.05))


def test_a_map_larger_than_a_message_may_be_can_be_told_on_this_machine() -> None:
    cells = np.zeros((2048, 2560), np.int8)
    packed = pack_cells(cells)
    with pytest.raises(TooLarge):
        unpack_cells(packed, *cells.shape)
    assert np.array_equal(unpack_cells(packed, *cells.shape, MAX_MAP_CELLS), cells)
