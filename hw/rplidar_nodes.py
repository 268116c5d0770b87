"""The RPLIDAR's standard scan, type 0x81: one beam in five bytes, and no checksum (SERIAL.md 1.6).

    b0  quality:6 notS:1 S:1      b1  angle_low:7 1      b2  angle_high:8      b3 b4  distance:16, quarters of a mm

What protects such a stream is that the angle grows by about a degree a node.  A node is believed when its check bits are
right and its angle follows from the node before; after a fault the search slides byte by byte until four nodes in a row
follow from one another.  The newest node is held back until the next one fits behind it: a lost byte spoils the node
that it was lost from, and that node's end then overlaps the next good one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hw.arrays import Bytes, Floats, Ints
from hw.byte_window import ByteWindow, Counters
from hw.framing import Frames
from hw.scan_assembler import Beams

NODE_BYTES = 5
TRUSTED_RUN = 4  # nodes in a row that follow from one another: by chance one in 10^7
LEAST_STEP_Q6, MOST_STEP_Q6 = -32, 256  # -0.5 deg (jitter of the device's interpolation) .. 4 deg (2 kHz at 15 Hz, and reserve)
CIRCLE_Q6 = 360 * 64


@dataclass(frozen=True, slots=True)
class Node:
    """One beam, in the sensor's units."""

    is_start: bool
    quality: int  # 0..63
    angle_q6: int  # 1/64 degree, clockwise
    distance_q2: int  # 1/4 mm, 0: nothing

    def encode(self) -> bytes:
        head = self.quality << 2 | (1 if self.is_start else 2)
        angle, distance = self.angle_q6, self.distance_q2
        return bytes((head, (angle & 0x7F) << 1 | 1, angle >> 7, distance & 0xFF, distance >> 8))

    @staticmethod
    def decode(data: bytes | bytearray) -> Node | None:
        """The node in these 5 bytes, or None when its check bits say it is none."""
        if len(data) != NODE_BYTES or not is_node(data, 0):
            return None
        angle_q6 = data[1] >> 1 | data[2] << 7
        return Node(bool(data[0] & 1), data[0] >> 2, angle_q6, data[3] | data[4] << 8)


def is_node(data: bytes | bytearray, at: int) -> bool:
    """Do the check bits at this position fit a node?"""
    head = data[at]
    return bool((head ^ head >> 1) & 1 and data[at + 1] & 1)


def follows(before_q6: int, after_q6: int) -> bool:
    """Can the beam after one at `before_q6` lie at `after_q6`?"""
    step = (after_q6 - before_q6 + CIRCLE_Q6 // 2) % CIRCLE_Q6 - CIRCLE_Q6 // 2
    return LEAST_STEP_Q6 <= step <= MOST_STEP_Q6


class NodeFinder:
    """Nodes out of a window.  While in step, the window begins with a node that is believed but held back."""

    def __init__(self) -> None:
        self._is_in_step = False
        self._has_held = False

    def restart(self) -> None:
        """The stream begins anew."""
        self._is_in_step = self._has_held = False

    def take(self, window: ByteWindow, counters: Counters) -> Frames:
        """All nodes that are certain by now."""
        nodes: list[bytes] = []
        behind: list[int] = []
        gaps: list[int] = []

        def emit(at: int) -> None:
            nodes.append(bytes(window.data[at : at + NODE_BYTES]))
            behind.append(len(window) - at - NODE_BYTES)
            gaps.append(counters.good())

        while True:
            if self._is_in_step:
                self._walk(window, emit)
                if len(window) < 2 * NODE_BYTES:
                    break
                self._is_in_step, self._has_held = False, True
                counters.bad_frames += 1
            if not self._resync(window, emit):
                break
        window.trim()
        data = np.frombuffer(b"".join(nodes), np.uint8).reshape(-1, NODE_BYTES)
        return Frames(data, np.array(behind, np.int64), np.array(gaps, np.int64))

    def _walk(self, window: ByteWindow, emit: Callable[[int], None]) -> None:
        """Emit nodes while the next one follows."""
        data, at, n = window.data, 0, len(window)
        angle_q6 = data[1] >> 1 | data[2] << 7
        while at + 2 * NODE_BYTES <= n:
            head, low = data[at + 5], data[at + 6]
            next_q6 = low >> 1 | data[at + 7] << 7
            step = (next_q6 - angle_q6 + CIRCLE_Q6 // 2) % CIRCLE_Q6 - CIRCLE_Q6 // 2
            if not ((head ^ head >> 1) & low & 1 and LEAST_STEP_Q6 <= step <= MOST_STEP_Q6):
                break
            emit(at)
            angle_q6 = next_q6
            at += NODE_BYTES
        window.take(at)

    def _resync(self, window: ByteWindow, emit: Callable[[int], None]) -> bool:
        """Find four nodes that follow from one another, beginning inside the held node at the earliest."""
        held = NODE_BYTES if self._has_held else 0
        untried = max(0, len(window) - TRUSTED_RUN * NODE_BYTES + 1)
        at = next((at for at in range(min(held, 1), untried) if _is_run(window.data, at)), None)
        begin = untried if at is None else at
        if begin >= held:  # the held node is whole
            if held:
                emit(0)
                window.take(held)
                self._has_held = False
            window.skip(begin - held)
        elif at is not None:  # a run begins inside the held node, so that was not one
            window.skip(at)
            self._has_held = False
        self._is_in_step = at is not None
        return at is not None


def _angle_q6(data: bytes | bytearray, at: int) -> int:
    return data[at + 1] >> 1 | data[at + 2] << 7


def _is_run(data: bytes | bytearray, at: int) -> bool:
    if not is_node(data, at):
        return False
    before_q6 = _angle_q6(data, at)
    for k in range(1, TRUSTED_RUN):
        next_at = at + k * NODE_BYTES
        if not is_node(data, next_at) or not follows(before_q6, after_q6 := _angle_q6(data, next_at)):
            return False
        before_q6 = after_q6
    return True


def beams(nodes: Bytes, gaps: Ints, sent_s: Floats) -> Beams:
    """What nodes say, with the bytes skipped before each and the time at which each was begun to be sent."""
    words = nodes.astype(np.int64)
    turn_deg = (words[:, 1] >> 1 | words[:, 2] << 7) / 64.0
    mm = (words[:, 3] | words[:, 4] << 8) / 4.0
    return Beams(
        turn_deg=turn_deg,
        angles_rad=-np.radians(turn_deg),
        ranges_m=np.where(mm == 0, np.nan, mm / 1e3),
        stamps_s=sent_s,
        intensities=(words[:, 0] >> 2).astype(np.float64),
        is_dirty=gaps > 0,
    )
