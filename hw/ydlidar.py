"""YDLIDAR X2, X4, G2, G4, S2, Tmini, TG ...: who it is, how it is started, and its scan; the bytes are in `ydlidar_wire`.

One-way units stream from power-up and hear nothing; two-way units are asked who they are and told to scan.  How wide a
unit's samples are is found by the checksum of its packets.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hw import ydlidar_wire as wire
from hw.arrays import Bytes, Floats, Ints, median
from hw.driver import Ask, Drain, Pause, Reading, Script, Send, SetLines
from hw.errors import DeviceError, DeviceSilent
from hw.framing import Frames, SizedFrames
from hw.rplidar_wire import Descriptor, xor8
from hw.scan_assembler import Beams
from hw.spinning import SpinningLidar, carried
from hw.ydlidar_wire import HEAD_BYTES, HEADER, MODELS, MOST_SAMPLES

MOST_STEP_DEG = 3.0  # X2 at 3 kHz and 12 Hz: 1.44; a packet that spans more ran backwards or is damaged
UNLOCK_AFTER = 8  # bad frames in a row, after which another sample width is thought possible


class YdLidar(SpinningLidar):
    """Driver of the family.  Without a model the unit is asked; one that does not answer is taken for an X2."""

    doubts_before_gap = True  # another packet's distances look like a wall, and equal bytes cancel in an XOR

    def __init__(self, model: str | None = None, intensity_bits: int | None = None) -> None:
        self.model = MODELS[model or "x4"]
        super().__init__(wire.RANGE_MIN_M, self.model.range_max_m)
        self._is_given = model is not None
        self.identity.model = f"YDLIDAR {self.model.name}" if model else "YDLIDAR"
        self.bauds = (self.model.baud,) if model else (128000, 115200, 230400, 512000, 153600)
        self.baud = self.bauds[0]
        self._widths = (2, 3, 4) if intensity_bits is None else ({0: 2, 8: 3, 10: 3, 16: 4}[intensity_bits],)
        self._intensity_bits = intensity_bits or 8
        self._width = self._widths[0] if len(self._widths) == 1 else 0  # 0: not known yet
        self._misses = 0
        self._finder = SizedFrames(b"\xaa", HEAD_BYTES, HEAD_BYTES + 4 * MOST_SAMPLES, self._size, lambda _: True)
        self._info: bytes | None = None
        self._health: bytes | None = None
        self._usual_step_deg = 0.0
        self._last_q6 = 0

    def start(self) -> Script:
        """Quiet, who are you, scan, spin; a one-way unit just streams."""
        if not self.model.is_two_way:
            yield SetLines(dtr=self.model.motor_dtr)
            return
        yield Send(wire.command(wire.FORCE_STOP))
        yield Send(wire.command(wire.STOP))
        is_quiet = yield Drain(quiet_s=0.06, max_s=0.4)
        self.restart()
        yield SetLines(dtr=self.model.motor_dtr)
        if not is_quiet and not self._is_given:
            return  # it streams and does not hear: one-way
        self._info = self._health = None
        info = yield Ask(wire.command(wire.INFO), lambda: self._info, 0.3)
        if info is None and self._is_given:
            raise DeviceSilent(f"no answer at {self.baud} baud; is it a YDLIDAR {self.model.name}, and is it powered?")
        if info is None:
            return
        health = yield Ask(wire.command(wire.HEALTH), lambda: self._health, 0.3)
        if health is not None and health[0] & 3 >= 2:
            raise DeviceError(
                f"the LIDAR reports a fault, status {health[0]:#04x}; is the head blocked? unplug it and plug it in again"
            )
        yield Send(wire.command(wire.SCAN))

    def stop(self) -> Script:
        """See `Driver.stop`."""
        if self.model.is_two_way:
            yield Send(wire.command(wire.FORCE_STOP))
            yield Send(wire.command(wire.STOP))
        yield SetLines(dtr=not self.model.motor_dtr)
        yield Pause(0.01)

    def feed(self, data: bytes, now_s: float) -> list[Reading]:
        """Scans that these bytes complete."""
        self._arrive(data, now_s)
        self._take_answers()
        frames = self._finder.take(self._window, self.counters)
        is_scan = frames.data[:, 1] == HEADER[1]
        frames = Frames(frames.data[is_scan], frames.behind[is_scan], frames.gap[is_scan])
        is_turn = False
        for row in frames.data[:, 4:6].tolist():
            first_q6 = row[0] >> 1 | row[1] << 7
            is_turn |= first_q6 < self._last_q6
            self._last_q6 = first_q6
        return self._hold(frames, now_s, is_turn)

    def _take_answers(self) -> None:
        """Answers come with the same descriptor as an RPLIDAR's, only at the start."""
        data = self._window.data
        while (at := data.find(b"\xa5\x5a")) >= 0:
            descriptor = Descriptor.decode(data[at : at + 7])
            if descriptor is None or len(data) < at + 7 + (0 if descriptor.is_multi else descriptor.length):
                return
            body = bytes(data[at + 7 : at + 7 + (0 if descriptor.is_multi else descriptor.length)])
            if descriptor.type == wire.INFO_TYPE:
                self._learn(body)
            elif descriptor.type == wire.HEALTH_TYPE:
                self._health = body
            del data[at : at + 7 + len(body)]

    def _learn(self, info: bytes) -> None:
        if len(info) != 20:
            return
        self._info = info
        self.identity.firmware = f"{info[2]}.{info[1]}"
        self.identity.serial = "".join(str(digit % 10) for digit in info[4:])
        if not self._is_given and info[0] in wire.NUMBERS:
            self.model = MODELS[wire.NUMBERS[info[0]]]
            self.identity.model = f"YDLIDAR {self.model.name}"

    def _size(self, data: bytearray) -> int:
        """Length of the packet at the front; 0: it is none."""
        if data[1] == wire.CLOCK_HEADER[1]:
            return 8 if xor8(data[:8]) == 0 else 0
        n = data[3]
        if data[1] != HEADER[1] or not 1 <= n <= MOST_SAMPLES or not data[4] & data[6] & 1:
            return 0
        if not self._width:
            return self._size_unlocked(data, n)
        size = HEAD_BYTES + n * self._width
        if len(data) < size:
            return size
        if wire.words_xor(bytes(data[:size]), self._width) == data[8] | data[9] << 8:
            self._misses = 0
            return size
        self._misses += 1
        if self._misses >= UNLOCK_AFTER and len(self._widths) > 1:
            self._width, self._misses = 0, 0
        return 0

    def _size_unlocked(self, data: bytearray, n: int) -> int:
        """While the sample width is not known: the one whose checksum fits and behind which the next packet begins.

        The checksum alone does not tell: an even number of equal distances has the XOR of none.
        """
        most = HEAD_BYTES + n * self._widths[-1] + 2
        if len(data) < most:
            return most  # wait
        for width in self._widths:
            size = HEAD_BYTES + n * width
            is_followed = data[size : size + 2] in (HEADER, wire.CLOCK_HEADER)
            if is_followed and wire.words_xor(bytes(data[:size]), width) == data[8] | data[9] << 8:
                self._width = width if n > 4 else 0
                return size
        return 0

    def _follow(self, data: Bytes, is_strict: bool) -> NDArray[np.bool_]:
        angles_deg = np.floor(np.ascontiguousarray(data[:, 4:8]).view("<u2") / 2) / 64
        self._learn_step(angles_deg, data[:, 3].astype(np.int64))
        between_deg = (angles_deg[1:, 0] - angles_deg[:-1, 1] + 180) % 360 - 180
        usual_deg = self._usual_step_deg
        least_deg, most_deg = (usual_deg - 0.25, usual_deg + 0.25) if is_strict else (-0.3, 4 * usual_deg + 0.5)
        follows: NDArray[np.bool_] = (between_deg > least_deg) & (between_deg < most_deg)
        return follows

    def _learn_step(self, angles_deg: Floats, n: Ints) -> None:
        """The usual angle between samples, from packets long enough to tell."""
        step_deg = (angles_deg[:, 1] - angles_deg[:, 0]) % 360.0 / np.maximum(n - 1, 1)
        told = step_deg[(n > 4) & (step_deg < MOST_STEP_DEG) & (step_deg > 0)]
        if len(told):
            usual_deg = median(told)
            has_changed = len(told) >= 4 and abs(usual_deg - self._usual_step_deg) > 0.1 * self._usual_step_deg
            self._usual_step_deg = usual_deg if has_changed else 0.8 * self._usual_step_deg + 0.2 * usual_deg

    def _beams(self, frames: Bytes, gaps: Ints, arrivals_s: Floats) -> Beams:
        head = np.ascontiguousarray(frames[:, 4:8]).view("<u2").astype(np.float64)
        n = frames[:, 3].astype(np.int64)
        first_deg, last_deg = np.floor(head[:, 0] / 2) / 64, np.floor(head[:, 1] / 2) / 64
        step_deg = np.where(n > 1, (last_deg - first_deg) % 360.0 / np.maximum(n - 1, 1), 0.0)
        is_sane = self._are_sane(first_deg, last_deg, step_deg, n)
        dirty = carried((gaps > 0) | ~is_sane, is_sane)
        frames, n, first_deg, step_deg, arrivals_s = (
            frames[is_sane],
            n[is_sane],
            first_deg[is_sane],
            step_deg[is_sane],
            arrivals_s[is_sane],
        )
        index = np.arange(MOST_SAMPLES)
        is_there = index < n[:, None]
        mm, intensities = self._samples(frames)
        turn_deg = (first_deg[:, None] + step_deg[:, None] * index) % 360.0
        angle_deg = turn_deg + wire.correction_deg(mm) if self.model.is_corrected else turn_deg
        sample_s = self._usual_step_deg / 360.0 * self.period_s
        sent_s = (HEAD_BYTES + n * (self._width or 2)) * 10.0 / self.baud
        stamps_s = (arrivals_s - sent_s)[:, None] - sample_s * (n[:, None] - 1 - index)
        return Beams(
            turn_deg=turn_deg[is_there],
            angles_rad=-np.radians(angle_deg)[is_there],
            ranges_m=np.where(mm == 0, np.nan, mm / 1e3)[is_there],
            stamps_s=stamps_s[is_there],
            intensities=intensities[is_there] if (self._width or 2) > 2 else None,
            is_dirty=np.repeat(dirty, n),
        )

    def _samples(self, frames: Bytes) -> tuple[Floats, Floats]:
        """Millimetres and intensities, (M, 80) each."""
        width = self._width or 2
        values = (
            frames[:, HEAD_BYTES : HEAD_BYTES + width * MOST_SAMPLES].reshape(len(frames), MOST_SAMPLES, width).astype(np.int64)
        )
        word = values[:, :, -2] | values[:, :, -1] << 8
        quarters = word if width == 2 else word & 0xFFFC  # the low bits beside an intensity are flags, or its high bits
        mm = quarters / 4.0 if self.model.is_triangle else word.astype(np.float64)
        if width == 4:
            intensities = values[:, :, 0] | values[:, :, 1] << 8
        else:
            intensities = values[:, :, 0] | ((word & 3) << 8 if self._intensity_bits == 10 else 0)
        return mm, intensities.astype(np.float64)

    def _are_sane(self, first_deg: Floats, last_deg: Floats, step_deg: Floats, n: Ints) -> NDArray[np.bool_]:
        """Which packets can be true: angles on the circle, samples as dense as usual (one backwards spans the circle)."""
        can_be = (first_deg <= 360) & (last_deg <= 360) & (step_deg < MOST_STEP_DEG)
        usual_deg = self._usual_step_deg
        if self._is_strict:
            fits = np.abs(step_deg - usual_deg) * (n - 1) < 0.01 * usual_deg * n + 0.05
        else:
            fits = step_deg < 2 * usual_deg
        is_sane: NDArray[np.bool_] = can_be & ((n <= 4) | fits)
        self.counters.rejected += int(np.count_nonzero(~is_sane))
        return is_sane
