"""What `mapquilt merge -o OUT` writes: the fused map, a picture of each pair before and after, and one of all that joined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.commands.merge_files import LoadedMap, Merged, Pair, figures_of
from agent.files import write_atomically
from agent.map_files import save_map
from agent.merging.arrays import at_corner
from agent.merging.errors import FusionError
from agent.merging.fusion import FusedMap, fuse
from agent.merging.matched_features import matched_features
from agent.merging.resampling import resampled_like
from agent.view.group_picture import Member, group_picture
from agent.view.merge_picture import MapToDraw, Overlay, merge_picture
from agent.view.render import png
from protocol.geometry import SE2


def base_name(output: Path) -> Path:
    """What the names of all files begin with."""
    return output.with_suffix("") if output.suffix in (".yaml", ".yml", ".pgm", ".png") else output


def write_merged(merged: Merged, output: Path, resolution_m: float | None) -> list[Path]:
    """The fused map in the first map's frame, and a picture of every pair that has a hypothesis; returns what was written."""
    base = base_name(output)
    written: list[Path] = []
    if len(merged.T_first) > 1:
        merged.fused = _fused_in_first_frame(merged, resolution_m)
        written += save_map(merged.fused.grid, base)
    for i, j in merged.results:
        name = base.name if len(merged.maps) == 2 else f"{base.name}-{i + 1}-{j + 1}"
        path = base.with_name(f"{name}.png")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, png(pair_picture(merged, (i, j))))
        written.append(path)
    if merged.fused is not None and len(merged.maps) > 2:
        path = base.with_name(f"{base.name}.png")
        write_atomically(path, png(all_together(merged, merged.fused)))
        written.append(path)
    return written


def _fused_in_first_frame(merged: Merged, resolution_m: float | None) -> FusedMap:
    """On the first map's own lattice, so that its cells stay as they are; a map whose frame is turned is drawn upright."""
    first = merged.maps[0].grid.origin
    T_lattice_corner = _lattice(merged)
    laid = [(at_corner(merged.maps[i].grid), T_lattice_corner @ T) for i, T in sorted(merged.T_first.items())]
    fused = fuse(laid, resolution_m)
    if first.theta_rad != 0:
        return fused
    return replace(fused, grid=replace(fused.grid, origin=first @ fused.grid.origin))


def all_together(merged: Merged, fused: FusedMap) -> NDArray[np.uint8]:
    """Every map by itself, and those that joined on one sheet."""
    first, T_lattice_corner = merged.maps[0].grid.origin, _lattice(merged)
    T_lattice_file = T_lattice_corner @ first.inverse()
    on_lattice = replace(fused.grid, origin=T_lattice_file @ fused.grid.origin)
    members = []
    for i, loaded in enumerate(merged.maps):
        corner, T = at_corner(loaded.grid), merged.T_first.get(i)
        laid = None if T is None else resampled_like(on_lattice, corner, T_lattice_corner @ T)
        members.append(Member(Path(loaded.name).name, corner, laid))
    figures = [f"{fused.grid.known_area_m2():.0f} m2 known", f"{fused.conflicting_cells} cells conflict"]
    return group_picture(members, fused.grid, fused.conflicts, figures)


def pair_picture(merged: Merged, pair: Pair) -> NDArray[np.uint8]:
    """Before and after: both maps with their features, and theirs laid on ours at the best hypothesis."""
    a, b = (merged.maps[i] for i in pair)
    result = merged.results[pair]
    T = result.T_ours_theirs
    if T is None:
        return merge_picture(_to_draw(a, {}), _to_draw(b, {}), None, merged.verdict(pair), figures_of(result))
    same = matched_features(a.snapshot.features, b.snapshot.features, T)
    kinds = {"lines": same.lines, "circles": same.circles, "arcs": same.arcs, "curves": same.curves}
    longest_first = np.argsort(-a.snapshot.features.lines[same.lines[:, 0], 3], kind="stable")
    kinds["lines"] = same.lines[longest_first]
    ours = _to_draw(a, {kind: rows[:, 0].tolist() for kind, rows in kinds.items()})
    theirs = _to_draw(b, {kind: rows[:, 1].tolist() for kind, rows in kinds.items()})
    verdict = merged.verdict(pair) + ("" if result.accepted else "; below, the best hypothesis")
    return merge_picture(ours, theirs, _overlay(a, b, T), verdict, [*figures_of(result), f"{len(same)} matched features"])


def _to_draw(loaded: LoadedMap, matched: Mapping[str, list[int]]) -> MapToDraw:
    everything = {kind: matched.get(kind, []) for kind in ("lines", "circles", "arcs", "curves")}
    return MapToDraw(Path(loaded.name).name, loaded.snapshot.grid, loaded.snapshot.features, everything)


def _overlay(a: LoadedMap, b: LoadedMap, T: SE2) -> Overlay | None:
    ours, theirs = a.snapshot.grid, b.snapshot.grid
    try:
        fused = fuse([(ours, SE2.identity()), (theirs, T)])
    except FusionError:  # a rejected hypothesis may lie kilometres away: nothing to see there
        return None
    cells = [resampled_like(fused.grid, grid, T_frame) for grid, T_frame in ((ours, SE2.identity()), (theirs, T))]
    return Overlay(fused.grid, cells[0], cells[1], fused.conflicts, SE2.identity(), T)


def _lattice(merged: Merged) -> SE2:
    """Where the first map's corner lies on the merged lattice: on its own cells, or upright when its frame is turned."""
    first = merged.maps[0].grid.origin
    return SE2.identity() if first.theta_rad == 0 else first
