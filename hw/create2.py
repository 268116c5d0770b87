"""iRobot Create 2 and Roomba 600 and later: the Open Interface's sensor stream, 16-bit encoders (SERIAL.md 7.1).

    13 n {id data}* chk        every 15 ms once asked; big-endian; the low byte of the sum of the whole frame is 0

Packets 43 and 44 count the wheels and wrap at 65536 both ways: 0.444565 mm a count, so after 29.1 m.
"""

from __future__ import annotations

from collections.abc import Mapping

from hw.byte_window import ByteWindow, Counters
from hw.framing import SizedFrames
from hw.odometry import Quiet, TickSample, WheelGeometry

HEADER = b"\x13"
START, SAFE, STREAM, PAUSE_STREAM = 128, 131, 148, 150
LEFT_ENCODER, RIGHT_ENCODER = 43, 44
_WORDS = (19, 20, 22, 23, *range(25, 32), 33, *range(39, 45), *range(46, 52), *range(54, 58))
SIZES = {packet: 2 if packet in _WORDS else 1 for packet in range(7, 59)}  # bytes of each sensor packet
_SPANS = {0: (7, 26), 1: (7, 16), 2: (17, 20), 3: (21, 26), 4: (27, 34), 5: (35, 42), 6: (7, 42)}
_SPANS |= {100: (7, 58), 101: (43, 58), 106: (46, 51), 107: (54, 58)}
GROUPS = {group: tuple(range(first, last + 1)) for group, (first, last) in _SPANS.items()}
MOST_BYTES = 170  # what fits a slot of 15 ms at 115200 baud
METRES_PER_TICK = 0.072 * 3.141592653589793 / 508.8
TRACK_M = 0.235
MAX_SPEED_MPS = 0.5


def encode_value(packet: int, value: int) -> bytes:
    """The bytes of one sensor packet; counters wrap, negative values are two's complement."""
    bits = 8 * SIZES[packet]
    return (value % (1 << bits)).to_bytes(SIZES[packet], "big")


def encode_stream(values: Mapping[int, int]) -> bytes:
    """A stream frame with these packets, in their order."""
    return framed(b"".join(bytes((packet,)) + encode_value(packet, value) for packet, value in values.items()))


def framed(body: bytes) -> bytes:
    """A stream frame around packets, each its id and its bytes."""
    frame = HEADER + bytes((len(body),)) + body
    return frame + bytes((-sum(frame) & 0xFF,))


def decode_stream(frame: bytes) -> dict[int, int] | None:
    """{packet: value} of a whole frame; None when it is none, or holds a packet whose size we do not know."""
    if len(frame) < 4 or frame[:1] != HEADER or len(frame) != frame[1] + 3 or sum(frame) & 0xFF:
        return None
    values, at = {}, 2
    while at < len(frame) - 1:
        size = SIZES.get(frame[at], 0)
        if not size or at + 1 + size > len(frame) - 1:
            return None
        values[frame[at]] = int.from_bytes(frame[at + 1 : at + 1 + size], "big")
        at += 1 + size
    return values


def stream_request(packets: tuple[int, ...]) -> bytes:
    """Ask for these packets every 15 ms."""
    return bytes((STREAM, len(packets), *packets))


class Create2(Quiet):
    """`BaseProtocol` of a Create 2."""

    baud_rates: tuple[int, ...] = (115200, 19200)

    def __init__(self, geometry: WheelGeometry | None = None) -> None:
        self.geometry = geometry or WheelGeometry(METRES_PER_TICK, TRACK_M, MAX_SPEED_MPS)
        self.counters = Counters()
        self._window = ByteWindow(self.counters)
        self._finder = SizedFrames(HEADER, 2, MOST_BYTES + 3, _size, lambda frame: decode_stream(frame) is not None)

    def start_requests(self) -> list[bytes]:
        return [bytes((START,)), bytes((SAFE,)), stream_request((LEFT_ENCODER, RIGHT_ENCODER)), bytes((PAUSE_STREAM, 1))]

    def stop_requests(self) -> list[bytes]:
        return [bytes((PAUSE_STREAM, 0))]

    def feed(self, data: bytes) -> list[TickSample]:
        """Samples that these bytes complete."""
        self._window.push(data)
        samples = []
        for frame in self._finder.take(self._window, self.counters).data:
            values = decode_stream(bytes(frame[: int(frame[1]) + 3])) or {}
            if LEFT_ENCODER in values and RIGHT_ENCODER in values:
                samples.append(TickSample(values[LEFT_ENCODER], values[RIGHT_ENCODER], 16))
        return samples


def _size(data: bytearray) -> int:
    return data[1] + 3 if 2 <= data[1] <= MOST_BYTES else 0
