"""Trinary cells as few bytes, and only those that changed.

A cell is one of three values, so five fit into a byte (3^5 = 243); the five are stacked *vertically*, which leaves
walls and free space as long runs for zlib.  A map is cut into tiles of 64x64 cells on a lattice that never moves while
the map grows.  What travels is the difference to a map the receiver already holds, cell by cell modulo 3: where nothing
changed it is zero and costs nothing.  "Everything" is the difference to the empty map.

    row 64n+4 ┐
    ...       ├─ one byte: t0 + 3 t1 + 9 t2 + 27 t3 + 81 t4      t: 0 unknown, 1 free, 2 occupied
    row 64n   ┘
"""

from __future__ import annotations

import hashlib
import math
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from protocol.errors import LocalProtocolError, RemoteProtocolError, TooLarge
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

TILE_CELLS = 64
TILE_BYTES = 13 * TILE_CELLS  # ceil(64 / 5) rows of bytes
MAX_TILES = 16_384  # 67 million cells: 410 m x 410 m at 5 cm
MAX_MAP_CELLS = MAX_TILES * TILE_CELLS**2  # of a whole map, told to somebody on this machine
MAX_TILE_INDEX = 2**15 - 1
MAX_GRID_CELLS = 4_194_304  # a whole grid in one piece: the coarse map of 410 m x 410 m at 20 cm
ZLIB_LEVEL = 6  # 9 gains 5 % for eight times the time
MAX_PACKED_BYTE = 242

TileKey = tuple[int, int]  # (row, col) of a tile on the lattice

_POWERS = np.array([1, 3, 9, 27, 81], np.uint8)
_CELL_TO_TRIT = np.full(256, 255, np.uint8)
_CELL_TO_TRIT[[UNKNOWN & 0xFF, FREE, OCCUPIED]] = (0, 1, 2)
_TRIT_TO_CELL = np.array([UNKNOWN, FREE, OCCUPIED], np.int8)
_BYTE_TO_TRITS = (np.arange(243)[:, None] // _POWERS.astype(np.int64) % 3).astype(np.uint8)  # (243, 5)
_NO_TILE = bytes(TILE_BYTES)


def pack_cells(cells: NDArray[np.int8]) -> bytes:
    """(H, W) cells in one piece: five vertical cells a byte, then zlib."""
    return zlib.compress(_pack_trits(_trits(cells)).tobytes(), ZLIB_LEVEL)


def unpack_cells(data: bytes, height: int, width: int, most_cells: int = MAX_GRID_CELLS) -> NDArray[np.int8]:
    """The (H, W) cells of `pack_cells`; anything but exactly these is a `RemoteProtocolError`."""
    if not (height >= 1 and width >= 1 and height * width <= most_cells):
        raise TooLarge(f"grid of {height} x {width} cells; 1 to {most_cells} cells are allowed")
    rows = -(-height // 5)
    packed = np.frombuffer(inflate(data, rows * width), np.uint8).reshape(rows, width)
    _check_packed(packed)
    trits = _unpack_trits(packed)
    if trits[height:].any():
        raise RemoteProtocolError(f"grid of {height} rows has cells beyond its last row")
    return _TRIT_TO_CELL[trits[:height]]


@dataclass(frozen=True, slots=True)
class TileMap:
    """A map as packed tiles on a lattice; tiles of unknown cells only are left out.  Equal digests are equal maps."""

    resolution_m: float
    anchor: SE2  # pose of the lattice: cell (0, 0) of tile (0, 0) has its lower-left corner here
    tiles: Mapping[TileKey, bytes]
    digest: bytes = field(default=b"", compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "digest", _digest(self))

    @staticmethod
    def empty(resolution_m: float, anchor: SE2) -> TileMap:
        return TileMap(resolution_m, anchor, {})

    @staticmethod
    def of(grid: OccupancyGrid, previous: TileMap | None = None) -> TileMap:
        """Cut a grid into tiles, on the lattice of `previous` when the grid still lies on it."""
        anchor, corner = _lattice(grid, previous)
        first_row, first_col = corner[0] // TILE_CELLS, corner[1] // TILE_CELLS
        above, left = corner[0] - first_row * TILE_CELLS, corner[1] - first_col * TILE_CELLS
        n_rows, n_cols = -(-(above + grid.height) // TILE_CELLS), -(-(left + grid.width) // TILE_CELLS)
        trits = np.zeros((n_rows * TILE_CELLS, n_cols * TILE_CELLS), np.uint8)
        trits[above : above + grid.height, left : left + grid.width] = _trits(grid.cells)
        blocks = trits.reshape(n_rows, TILE_CELLS, n_cols, TILE_CELLS).swapaxes(1, 2)
        used = np.argwhere(blocks.any(axis=(2, 3)))
        if len(used) > MAX_TILES:
            raise LocalProtocolError(f"map of {len(used)} tiles; at most {MAX_TILES} can travel: raise its resolution_m")
        packed = _pack_trits(blocks[used[:, 0], used[:, 1]])
        keys = [(int(r) + first_row, int(c) + first_col) for r, c in used]
        return TileMap(grid.resolution_m, anchor, dict(zip(keys, _split(packed.tobytes()), strict=True)))

    def grid(self) -> OccupancyGrid:
        """The known part as one grid: a pure function of the content, the same on every robot."""
        if not self.tiles:
            return OccupancyGrid(np.full((1, 1), UNKNOWN, np.int8), self.resolution_m, self.anchor)
        keys = np.array(sorted(self.tiles))
        first = keys.min(axis=0)
        n_rows, n_cols = keys.max(axis=0) - first + 1
        blocks = np.zeros((n_rows, n_cols, TILE_CELLS, TILE_CELLS), np.uint8)
        blocks[keys[:, 0] - first[0], keys[:, 1] - first[1]] = _tiles_to_trits([self.tiles[r, c] for r, c in keys.tolist()])
        cells = _TRIT_TO_CELL[blocks.swapaxes(1, 2).reshape(n_rows * TILE_CELLS, n_cols * TILE_CELLS)]
        side_m = TILE_CELLS * self.resolution_m
        corner = SE2(float(first[1]) * side_m, float(first[0]) * side_m, 0.0)
        return OccupancyGrid(cells, self.resolution_m, self.anchor @ corner).cropped()

    def sharing(self, earlier: TileMap) -> TileMap:
        """The same map, but what `earlier` has too is held once: of a map that grows, most tiles of most versions."""
        old = earlier.tiles
        return replace(self, tiles={key: old[key] if old.get(key) == tile else tile for key, tile in self.tiles.items()})

    def is_on_lattice_of(self, other: TileMap) -> bool:
        return self.resolution_m == other.resolution_m and self.anchor == other.anchor


@dataclass(frozen=True, slots=True)
class TileDelta:
    """What turns the map `base_digest` (empty: the empty map) into the map `digest`."""

    base_digest: bytes
    digest: bytes  # 16 bytes
    resolution_m: float
    anchor: SE2
    keys: tuple[TileKey, ...]  # sorted
    payload: bytes  # zlib of the changed tiles, cell by cell new minus old modulo 3

    @staticmethod
    def between(base: TileMap | None, new: TileMap) -> TileDelta:
        """The difference from `base`, or everything when there is no base or the lattice moved."""
        if base is not None and not base.is_on_lattice_of(new):
            base = None
        old = base.tiles if base is not None else {}
        keys = tuple(sorted(key for key in old.keys() | new.tiles.keys() if old.get(key) != new.tiles.get(key)))
        changed = _add_mod3([new.tiles.get(key, _NO_TILE) for key in keys], [old.get(key, _NO_TILE) for key in keys], -1)
        payload = zlib.compress(changed.tobytes(), ZLIB_LEVEL)
        return TileDelta(base.digest if base else b"", new.digest, new.resolution_m, new.anchor, keys, payload)

    def apply(self, base: TileMap | None) -> TileMap:
        """The new map; a `RemoteProtocolError` when base or bytes are not what they claim to be."""
        old: Mapping[TileKey, bytes] = {}
        if self.base_digest:
            if base is None or base.digest != self.base_digest:
                raise RemoteProtocolError("tile delta: its base is not the map held here")
            if base.resolution_m != self.resolution_m or base.anchor != self.anchor:
                raise RemoteProtocolError("tile delta: it moves the lattice of its base")
            old = base.tiles
        packed = np.frombuffer(inflate(self.payload, len(self.keys) * TILE_BYTES), np.uint8).reshape(-1, 13, TILE_CELLS)
        _check_packed(packed)
        if packed.size and int(packed[:, 12].max()) > 80:
            raise RemoteProtocolError("tile delta: cells beyond the last row of a tile")
        changed = _add_mod3(_split(packed.tobytes()), [old.get(key, _NO_TILE) for key in self.keys], 1)
        tiles = dict(old) | dict(zip(self.keys, _split(changed.tobytes()), strict=True))
        new = TileMap(self.resolution_m, self.anchor, {key: tile for key, tile in tiles.items() if tile != _NO_TILE})
        if len(new.tiles) > MAX_TILES:
            raise TooLarge(f"tile delta: the map grows to {len(new.tiles)} tiles; {MAX_TILES} are allowed")
        if new.digest != self.digest:
            raise RemoteProtocolError("tile delta: the result is not the map it announces")
        return new


def inflate(data: bytes, expected_bytes: int) -> bytes:
    """zlib data that is exactly `expected_bytes` long when unpacked; never unpacks more than that."""
    unpacker = zlib.decompressobj()
    try:
        plain = unpacker.decompress(data, expected_bytes + 1)
    except zlib.error as error:
        raise RemoteProtocolError(f"compressed bytes are damaged: {error}") from None
    if len(plain) != expected_bytes or not unpacker.eof or unpacker.unused_data:
        raise RemoteProtocolError(f"compressed bytes do not hold exactly {expected_bytes} bytes")
    return plain


def _trits(cells: NDArray[np.int8]) -> NDArray[np.uint8]:
    trits = _CELL_TO_TRIT[cells.view(np.uint8)]
    if trits.size and int(trits.max()) > 2:
        raise LocalProtocolError("a grid that travels has only unknown, free and occupied cells")
    return trits


def _pack_trits(trits: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(..., H, W) values 0 to 2 -> (..., ceil(H / 5), W) bytes."""
    *lead, height, width = trits.shape
    rows = -(-height // 5)
    padded = np.zeros((*lead, rows * 5, width), np.uint8)
    padded[..., :height, :] = trits
    stacked = padded.reshape(*lead, rows, 5, width)
    return np.asarray(np.einsum("...rkw,k->...rw", stacked, _POWERS, dtype=np.uint8, casting="unsafe"), np.uint8)


def _unpack_trits(packed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(..., R, W) bytes -> (..., 5 R, W) values 0 to 2."""
    *lead, rows, width = packed.shape
    return np.swapaxes(_BYTE_TO_TRITS[packed], -1, -2).reshape(*lead, rows * 5, width)


def _check_packed(packed: NDArray[np.uint8]) -> None:
    if packed.size and int(packed.max()) > MAX_PACKED_BYTE:
        raise RemoteProtocolError("packed cells hold a byte that is no five cells")


def _split(packed: bytes) -> list[bytes]:
    return [packed[i : i + TILE_BYTES] for i in range(0, len(packed), TILE_BYTES)]


def _tiles_to_trits(tiles: Iterable[bytes]) -> NDArray[np.uint8]:
    packed = np.frombuffer(b"".join(tiles), np.uint8).reshape(-1, 13, TILE_CELLS)
    return _unpack_trits(packed)[:, :TILE_CELLS]


def _add_mod3(tiles: list[bytes], others: list[bytes], sign: int) -> NDArray[np.uint8]:
    """Packed tiles, (N, 13, 64): cell by cell tile + sign * other, modulo 3."""
    if not tiles:
        return np.zeros((0, 13, TILE_CELLS), np.uint8)
    total = _tiles_to_trits(tiles) + (_tiles_to_trits(others) if sign > 0 else 3 - _tiles_to_trits(others))
    return _pack_trits(total % 3)


def _lattice(grid: OccupancyGrid, previous: TileMap | None) -> tuple[SE2, TileKey]:
    """The anchor to use, and the (row, col) of the grid's first cell on its lattice."""
    anchors = [SE2.identity()] if previous is None else [previous.anchor, SE2.identity()]
    for anchor in anchors:
        if previous is not None and previous.resolution_m != grid.resolution_m:
            continue
        corner = anchor.inverse() @ grid.origin
        row, col = corner.y_m / grid.resolution_m, corner.x_m / grid.resolution_m
        is_aligned = abs(corner.theta_rad) < 1e-9 and max(abs(row - round(row)), abs(col - round(col))) < 1e-4
        if is_aligned and max(abs(row), abs(col)) < TILE_CELLS * MAX_TILE_INDEX / 2:
            return anchor, (round(row), round(col))
    if not grid.origin.is_finite() or not math.isfinite(grid.resolution_m) or grid.resolution_m <= 0:
        raise LocalProtocolError(f"a grid at {grid.origin} with cells of {grid.resolution_m} m cannot travel")
    return grid.origin, (0, 0)


def _digest(tile_map: TileMap) -> bytes:
    anchor = tile_map.anchor
    place = (tile_map.resolution_m, anchor.x_m + 0.0, anchor.y_m + 0.0, anchor.theta_rad + 0.0)  # -0.0 is 0.0
    digest = hashlib.sha256(struct.pack("<4d", *place))
    for key in sorted(tile_map.tiles):
        digest.update(struct.pack("<2i", *key))
        digest.update(tile_map.tiles[key])
    return digest.digest()[:16]
