"""RPLIDAR A, C, S and T series: its scan in whatever mode it has (SERIAL.md 1); how that is started is `rplidar_start.py`.

In the stream of answers a descriptor may come at any time; what follows it is read accordingly.
"""

from __future__ import annotations

from hw import rplidar_hq, rplidar_nodes
from hw import rplidar_wire as wire
from hw.arrays import Bytes, Floats, Ints
from hw.byte_window import ByteWindow
from hw.driver import Reading
from hw.framing import FixedFrames
from hw.rplidar_capsule_chain import CapsuleChain
from hw.rplidar_capsules import KINDS, frames_of, start_angles_q6
from hw.rplidar_nodes import NodeFinder
from hw.rplidar_start import DEFAULT_PWM, DEFAULT_RPM, RplidarStart
from hw.scan_assembler import WITNESSES, Beams


class Rplidar(RplidarStart):
    """Driver of the whole family.  `mode`: "auto", one of `MODES`, or a number of the device's own list."""

    def __init__(self, mode: str = "auto", rpm: int = DEFAULT_RPM, pwm: int = DEFAULT_PWM) -> None:
        super().__init__(mode, rpm, pwm)
        self._single: wire.Descriptor | None = None
        self._nodes = NodeFinder()
        self._chain = CapsuleChain(self.counters)
        self._capsules: dict[int, FixedFrames] = {kind: frames_of(KINDS[kind]) for kind in KINDS}
        self._restart_stream()

    def restart(self) -> None:
        """See `Driver.restart`."""
        super().restart()
        self._single = None
        self._restart_stream()

    def _restart_stream(self) -> None:
        self._nodes.restart()
        self._chain.restart()
        self._last_angle_q6 = 0

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Scans that these bytes complete; answers are kept for the script."""
        self._arrive(data, now_s)
        readings: list[Reading] = []
        while True:
            if self._single is not None:
                if len(self._window) < self._single.length:
                    break
                self._answered(self._single.type, self._window.take(self._single.length))
                self._single = None
                continue
            at, descriptor = self._next_descriptor()
            if self.scan_type is not None:
                readings += self._feed_stream(at, now_s)
            if descriptor is None:
                break
            if self.scan_type is None:
                self._window.skip(at)
            self._begin(descriptor)
        if self.scan_type is None and self._single is None:
            self._window.skip_to(b"\xa5\x5a")
        return readings

    def _next_descriptor(self) -> tuple[int, wire.Descriptor | None]:
        data = self._window.data
        at = data.find(b"\xa5\x5a")
        while at >= 0:
            descriptor = wire.Descriptor.decode(data[at : at + wire.DESCRIPTOR_BYTES])
            if descriptor is not None:
                return at, descriptor
            at = data.find(b"\xa5\x5a", at + 1)
        return len(data), None

    def _begin(self, descriptor: wire.Descriptor) -> None:
        """A descriptor stands at the front of the window."""
        self._window.take(wire.DESCRIPTOR_BYTES)
        self.counters.gap_bytes = 0
        if descriptor.is_multi:
            self.scan_type = descriptor.type
            self._assembler.witnesses = (
                (1, 3) if descriptor.type in KINDS else WITNESSES
            )  # an XOR lets pairs of equal flips through
            self._restart_stream()
            self._drop_held()
            self._assembler.restart()
        else:
            self.scan_type, self._single = None, descriptor

    def _feed_stream(self, n: int, now_s: float) -> list[Reading]:
        """Read the first n bytes of the window as the running scan; a descriptor stands behind them if n is not all."""
        window = self._window
        if n < len(window):
            rest = bytes(window.data[n:])
            del window.data[n:]
            readings = self._take(window, now_s)
            window.clear()
            window.data.extend(rest)
            return readings
        return self._take(window, now_s)

    def _take(self, window: ByteWindow, now_s: float) -> list[Reading]:
        if self.scan_type == wire.NODE_TYPE:
            frames = self._nodes.take(window, self.counters)
            angles_q6 = [row[1] >> 1 | row[2] << 7 for row in frames.data.tolist()]
        elif self.scan_type == wire.HQ_TYPE:
            frames = rplidar_hq.FRAMES.take(window, self.counters)
            return self._hold(frames, now_s, len(frames) > 0)
        elif self.scan_type in self._capsules:
            frames = self._capsules[self.scan_type].take(window, self.counters)
            angles_q6 = (start_angles_q6(KINDS[self.scan_type], frames.data)[0]).tolist()
        else:
            window.skip(len(window))
            return []
        is_turn = False
        for angle_q6 in angles_q6:
            is_turn |= angle_q6 < self._last_angle_q6
            self._last_angle_q6 = angle_q6
        return self._hold(frames, now_s, is_turn)

    def _beams(self, frames: Bytes, gaps: Ints, arrivals_s: Floats) -> Beams:
        byte_s = 10.0 / self.baud
        if self.scan_type == wire.NODE_TYPE:
            return rplidar_nodes.beams(frames, gaps, arrivals_s - rplidar_nodes.NODE_BYTES * byte_s)
        if self.scan_type == wire.HQ_TYPE:
            return rplidar_hq.beams(frames, gaps, arrivals_s - rplidar_hq.FRAME_BYTES * byte_s, self.period_s)
        assert self.scan_type is not None
        return self._chain.beams(KINDS[self.scan_type], frames, gaps, arrivals_s, byte_s, self.period_s)

    def _witnessed(self, data: Bytes, gaps: Ints, arrivals_s: Floats) -> tuple[Bytes, Ints, Floats]:
        """Nodes were chosen by how they follow; capsules are chosen by the one behind them, when they are decoded."""
        return data, gaps, arrivals_s
