"""A mapper as bytes, and back: what the future of the map depends on, nothing else; how it is written, `state_block` says.

The drawing in progress is not stored: it is drawn again from the stored scans, to the same cell.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import astuple
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from agent.mapping.estimate import MapperStatus
from agent.mapping.kept_scans import KeptScan
from agent.mapping.likelihood import AREA
from agent.mapping.log_odds import LogOddsGrid
from agent.mapping.loop_closure import LoopCloser
from agent.mapping.packed_rows import PackedRows
from agent.mapping.particle_filter import NO_NUMBERS, NO_POSES
from agent.mapping.path_graph import LoopEdge
from agent.mapping.redrawing import Drawing
from agent.mapping.state_block import CheckpointError, State, opened, sealed
from agent.mapping.trajectory import ROW
from agent.mapping.twist import TwistMeans
from protocol.geometry import SE2

if TYPE_CHECKING:
    from agent.mapping.mapper import Mapper


def pack(mapper: Mapper) -> bytes:
    """One self-checking block."""
    return sealed(state_of(mapper))


def unpack(data: bytes, mapper: Mapper) -> None:
    """Fill a new mapper; raises CheckpointError and leaves it unusable when the bytes are not sound."""
    try:
        put_state(mapper, opened(data))
    except CheckpointError:
        raise
    except (ValueError, KeyError, TypeError, IndexError, struct.error, zlib.error, RecursionError, OverflowError) as error:
        raise CheckpointError(f"the saved map is damaged: {error}") from error


def state_of(mapper: Mapper) -> State:
    """Everything, flat."""
    local = mapper.map
    return {
        "resolution_m": mapper.options.resolution_m,
        "rng": mapper.rng.bit_generator.state,
        "epoch": mapper.epoch,
        "loops_closed": mapper.loops_closed,
        "status": mapper.status.value,
        "wheels.stretch": mapper.wheels.stretch,
        "wheels.sums": mapper.wheels.sums,
        "usual_fraction": mapper.usual_fraction,
        "contradictions": mapper.contradictions,
        "confirmations_missing": mapper.confirmations_missing,
        "lost_since_s": mapper.lost_since_s,
        "repeats": mapper.repeats,
        "repeats_since_s": mapper.repeats_since_s,
        "last_ranges": np.asarray(mapper.last_ranges, np.float32),
        "odometry.stamps_s": np.array(mapper.odometry.stamps_s),
        "odometry.poses": np.array(mapper.odometry.poses).reshape(-1, 3),
        "odometry.pieces": np.array(mapper.odometry.pieces, np.int64),
        "pose": local.pose,
        "last_scan_s": local.last_scan_s,
        "keyframe_pose": local.keyframe_pose,
        "keyframe_s": local.keyframe_s,
        "keyframe_variance": local.keyframe_variance,
        "scans": local.scans.rows.view(np.uint8).reshape(-1, ROW.itemsize),
        "twists": np.array(astuple(local.twists)),
        **search_state(mapper),
        **filter_state(mapper),
        **drawing_state(local.drawing),
        **loops_state(local.loops),
    }


def loops_state(loops: LoopCloser) -> State:
    rows = [(edge.a, edge.b, edge.T_a_b.x_m, edge.T_a_b.y_m, edge.T_a_b.theta_rad) for edge in loops.every_edge()]
    return {
        "loops.edges": np.array(rows, np.float64).reshape(-1, 5),
        "loops.is_pending": loops.pending is not None,
        "loops.next_look": loops.next_look,
        "loops.known": loops.known,
        "loops.misses": loops.misses,
        "loops.steps_from": loops.steps_from,
        "loops.breaks": np.array(loops.breaks, np.int64),
    }


def search_state(mapper: Mapper) -> State:
    """A search under way is begun again from its scan."""
    search = mapper.search
    if search is None:
        return {"search.stamp_s": math.nan}
    return {"search.stamp_s": search.stamp_s, "search.surfels": search.surfels, "search.next_heading": search.next_heading}


def filter_state(mapper: Mapper) -> State:
    particles = mapper.map.filter
    fields = particles.fields
    used, tables = numbered_anew(fields.tables)
    return {
        "poses": particles.poses,
        "log_weights": particles.log_weights,
        "next_parents": particles.next_parents,
        "followed": particles.followed,
        "forgotten": particles.forgotten,
        "lineage": np.array(particles.lineage, np.int64),
        "line": particles.line,
        "path_sizes": np.array([len(p) for p in particles.path], np.int64),
        "path": np.vstack([NO_POSES, *particles.path]),
        "parents": np.concatenate([NO_NUMBERS, *particles.parents]),
        "tables": tables.astype(np.int32),
        "tiles": fields.pool[used],
        "fields.first_tile": fields.first_tile,
    }


def numbered_anew(tables: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tiles in use and the tables by their new numbers, in order of appearance: equal fields make equal bytes.  0 stays 0."""
    tiles, first, inverse = np.unique(np.append(0, tables), return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return tiles[order], number[inverse[1:]].reshape(tables.shape)


def drawing_state(drawing: Drawing) -> State:
    scans = list(drawing.scans.values())
    return {
        **grid_state("grid", drawing.grid),
        **grid_state("base", drawing.base),
        "coarse.empty": drawing.coarse.empty,
        "coarse.first": drawing.coarse.first,
        "drawn.poses": drawing.poses,
        "drawn.oldest": drawing.oldest,
        "drawn.redrawn": drawing.redrawn,
        "drawn.thin_at": drawing.thin_at,
        "drawn.kept": np.array(list(drawing.scans), np.int64),
        "drawn.sizes": np.array([len(s.ends) for s in scans], np.int64),
        "drawn.ends": np.vstack([np.empty((0, 2), np.int16), *(s.ends for s in scans)]),
        "drawn.unit_m": np.array([s.unit_m for s in scans]),
        "drawn.hit_bits": np.concatenate([np.empty(0, np.uint8), *(s.hit_bits for s in scans)]),
        "drawn.is_partial": np.array([s.is_partial for s in scans], bool),
        "drawn.is_all_round": np.array([s.is_all_round for s in scans], bool),
        "fresh.poses": -1 if drawing.fresh is None else len(drawing.fresh.poses),
        "fresh.target": drawing.target,
        "fresh.is_bent": drawing.is_bending,
        "drawn.correction": drawing.correction,
    }


def grid_state(name: str, grid: LogOddsGrid) -> State:
    return {
        f"{name}.cells": grid.cells,
        f"{name}.first_tile": grid.first_tile,
        f"{name}.revision": grid.revision,
        f"{name}.tile_revisions": grid.tile_revisions,
    }


def put_state(mapper: Mapper, state: State) -> None:
    """The inverse of `state_of`."""
    if state["resolution_m"] != mapper.options.resolution_m:
        raise CheckpointError(
            f"the saved map has cells of {state['resolution_m']} m, the options say {mapper.options.resolution_m} m"
        )
    mapper.rng.bit_generator.state = state["rng"]
    mapper.epoch, mapper.status = state["epoch"], MapperStatus(state["status"])
    mapper.wheels.stretch, mapper.wheels.sums = state["wheels.stretch"], state["wheels.sums"]
    mapper.usual_fraction = state["usual_fraction"]
    mapper.contradictions, mapper.confirmations_missing = state["contradictions"], state["confirmations_missing"]
    mapper.lost_since_s, mapper.last_ranges = state["lost_since_s"], state["last_ranges"]
    mapper.repeats, mapper.repeats_since_s = state["repeats"], state["repeats_since_s"]
    mapper.odometry.stamps_s = state["odometry.stamps_s"].tolist()
    mapper.odometry.poses = [(x, y, theta) for x, y, theta in state["odometry.poses"].tolist()]
    mapper.odometry.pieces = state["odometry.pieces"].tolist()
    local = mapper.map
    local.pose, local.last_scan_s = state["pose"], state["last_scan_s"]
    local.keyframe_pose, local.keyframe_s, local.keyframe_variance = (
        state["keyframe_pose"],
        state["keyframe_s"],
        state["keyframe_variance"],
    )
    local.scans.rows = state["scans"].view(ROW)[:, 0]
    local.twists = TwistMeans(*state["twists"].tolist())
    put_filter(mapper, state)
    put_drawing(local.drawing, state)
    put_loops(local.loops, state)
    mapper.loops_closed = state["loops_closed"]
    put_search(mapper, state)


def put_loops(loops: LoopCloser, state: State) -> None:
    loops.edges = [LoopEdge(int(a), int(b), SE2(x, y, theta)) for a, b, x, y, theta in state["loops.edges"].tolist()]
    loops.pending = loops.edges.pop() if state["loops.is_pending"] else None
    loops.next_look, loops.known, loops.misses = state["loops.next_look"], state["loops.known"], state["loops.misses"]
    loops.steps_from, loops.breaks = state["loops.steps_from"], state["loops.breaks"].tolist()


def put_search(mapper: Mapper, state: State) -> None:
    if math.isnan(state["search.stamp_s"]):
        return
    mapper.search = mapper.map.search_for(state["search.surfels"], state["search.stamp_s"])
    while mapper.search.next_heading < state["search.next_heading"]:
        mapper.search.step()


def put_filter(mapper: Mapper, state: State) -> None:
    particles, tables, tiles = mapper.map.filter, state["tables"], state["tiles"]
    if len(state["poses"]) != len(tables) or tiles.shape[1:] != (AREA,) or (tables.size and tables.max() >= len(tiles)):
        raise CheckpointError("the saved map is damaged: particles and tiles do not fit together")
    particles.poses, particles.log_weights = state["poses"], state["log_weights"]
    particles.next_parents, particles.followed, particles.forgotten = state["next_parents"], state["followed"], state["forgotten"]
    particles.lineage, particles.line = state["lineage"].tolist(), state["line"]
    ends = np.cumsum(state["path_sizes"])[:-1]
    if len(state["path_sizes"]):
        particles.path = PackedRows(NO_POSES, np.split(state["path"], ends))
        particles.parents = PackedRows(NO_NUMBERS, np.split(state["parents"], ends))
    particles.fields.put(tables.astype(np.int64), tiles, state["fields.first_tile"])


def put_drawing(drawing: Drawing, state: State) -> None:
    put_grid(drawing.grid, "grid", state)
    put_grid(drawing.base, "base", state)
    drawing.coarse.empty, drawing.coarse.first = state["coarse.empty"], state["coarse.first"]
    drawing.poses, drawing.oldest, drawing.redrawn = state["drawn.poses"], state["drawn.oldest"], state["drawn.redrawn"]
    drawing.thin_at = state["drawn.thin_at"]
    put_kept(drawing, state)
    if state["fresh.poses"] >= 0:
        drawing.resume(state["fresh.target"], state["fresh.poses"], state["fresh.is_bent"])
    drawing.correction = state["drawn.correction"]


def put_kept(drawing: Drawing, state: State) -> None:
    sizes = state["drawn.sizes"]
    ends, bits = (
        np.split(state[name], np.cumsum(n)[:-1]) for name, n in (("drawn.ends", sizes), ("drawn.hit_bits", -(-sizes // 8)))
    )
    is_partial = state["drawn.is_partial"].tolist()
    is_all_round = state["drawn.is_all_round"].tolist()
    rows = zip(state["drawn.kept"].tolist(), ends, state["drawn.unit_m"].tolist(), bits, is_partial, is_all_round, strict=True)
    for k, one_ends, unit_m, one_bits, partial, all_round in rows if len(sizes) else ():
        # Each its own, or the scans that are let go later would stay with the others.
        drawing.scans[k] = KeptScan(one_ends.copy(), unit_m, one_bits.copy(), partial, all_round)


def put_grid(grid: LogOddsGrid, name: str, state: State) -> None:
    grid.cells, grid.first_tile = state[f"{name}.cells"], state[f"{name}.first_tile"]
    grid.revision, grid.tile_revisions = state[f"{name}.revision"], state[f"{name}.tile_revisions"]
