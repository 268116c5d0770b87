"""Three maps and more that became one: each by itself above, all of them on one sheet below, a colour a map.

A wall that one map alone knows has that map's colour, a wall that several agree on is dark, what they dispute is red.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.view.canvas import Canvas
from agent.view.render import robot_colour
from agent.view.sheet import (
    FAINT,
    GAP,
    INK,
    KNOWN_FREE,
    PAPER,
    RED,
    UNKNOWN,
    WIDTH,
    Colour,
    Image,
    centred,
    heading,
    in_a_row,
    legend,
    stacked,
    write,
)
from protocol.grid import FREE, OCCUPIED, OccupancyGrid

A_ROW = 4  # maps side by side
SEVERAL: Colour = INK
CONFLICT: Colour = RED
LEGEND = (
    ((SEVERAL,), "several maps agree"),
    ((CONFLICT,), "they conflict: unknown in the merged map"),
    ((UNKNOWN,), "unknown"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """One map: as it came, and what it says on the common lattice; None when it did not join."""

    name: str
    grid: OccupancyGrid
    laid: NDArray[np.int8] | None  # (H, W) as the fused map's cells


def group_picture(members: Sequence[Member], fused: OccupancyGrid, conflicts: NDArray[np.bool_], figures: Sequence[str]) -> Image:
    """The whole sheet."""
    joined = sum(member.laid is not None for member in members)
    verdict = f"{joined} of {len(members)} maps are one"
    strips = [_strip(members, first) for first in range(0, len(members), A_ROW)]
    canvas = Canvas.fitting(fused, WIDTH - 2 * GAP, max_height=1100)
    canvas.paint(_together(members, fused, conflicts))
    meaning = legend(LEGEND, "a map's own colour: it alone knows this wall")
    return stacked([heading(verdict, figures), *strips, meaning, centred(canvas.image, WIDTH)])


def _strip(members: Sequence[Member], first: int) -> Image:
    """A row of maps, each under its name and colour."""
    across = min(A_ROW, len(members))
    width = (WIDTH - (across + 1) * GAP) // across
    return in_a_row([_panel(member, first + i, width) for i, member in enumerate(members[first : first + A_ROW])])


def _panel(member: Member, index: int, width: int) -> Image:
    canvas = Canvas.fitting(member.grid, width, max_height=360)
    colours = np.full((*member.grid.cells.shape, 3), UNKNOWN, np.uint8)
    colours[member.grid.cells == FREE] = KNOWN_FREE
    colours[member.grid.cells == OCCUPIED] = robot_colour(index) if member.laid is not None else FAINT
    canvas.paint(colours)
    title = np.full((30, width, 3), PAPER, np.uint8)
    cv2.rectangle(title, (0, 6), (16, 22), robot_colour(index) if member.laid is not None else FAINT, -1)
    write(title, member.name + ("" if member.laid is not None else ": did not join"), 26, 20, 0.55, INK)
    return np.vstack([title, centred(canvas.image, width)])


def _together(members: Sequence[Member], fused: OccupancyGrid, conflicts: NDArray[np.bool_]) -> Image:
    """(H, W, 3) one pixel a cell of the fused map."""
    colours = np.full((*fused.cells.shape, 3), UNKNOWN, np.uint8)
    colours[fused.cells == FREE] = KNOWN_FREE
    near = np.zeros(fused.cells.shape, np.uint8)  # how many maps have a wall here or beside
    for member in members:
        if member.laid is not None:
            near += np.asarray(cv2.dilate((member.laid == OCCUPIED).astype(np.uint8), np.ones((3, 3), np.uint8)), np.uint8)
    for index, member in enumerate(members):
        if member.laid is not None:
            colours[(member.laid == OCCUPIED) & (near == 1)] = robot_colour(index)
    colours[(fused.cells == OCCUPIED) & (near > 1)] = SEVERAL
    colours[conflicts] = CONFLICT
    return colours
