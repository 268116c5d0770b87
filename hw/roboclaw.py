"""RoboClaw motor controllers, packet serial: one question and one answer at a time, big-endian.

    read    addr cmd            ->  data crc:u16          CRC-16/XMODEM over addr, cmd and data; SERIAL.md 7.4
    write   addr cmd data crc   ->  FF
    78      both encoder counters, u32 each

An answer has no header: it is known by its checksum, which also covers the question.
"""

from __future__ import annotations

import binascii
import struct

from hw.byte_window import Counters
from hw.odometry import Quiet, TickSample, WheelGeometry

BAUD_RATES = (38400, 115200, 460800, 230400, 57600, 19200, 9600)  # 38400 is the factory's; over USB any will do
FIRST_ADDRESS, LAST_ADDRESS = 0x80, 0x87
READ_M1, READ_M2, RESET_ENCODERS, READ_VERSION, READ_MAIN_BATTERY, READ_ENCODERS = 16, 17, 20, 21, 24, 78
ANSWER_BYTES = 10
POLL_PERIOD_S = 0.02


def crc16(data: bytes) -> int:
    """CRC-16/XMODEM; 0x31C3 over ASCII "123456789"."""
    return binascii.crc_hqx(data, 0)


def sealed(question: bytes, data: bytes) -> bytes:
    """The answer to a question: its data and the checksum over both."""
    return data + struct.pack(">H", crc16(question + data))


def opened(address: int, command: int, answer: bytes) -> bytes | None:
    """The data of an answer, or None when its checksum does not fit the question."""
    return answer[:-2] if len(answer) > 2 and crc16(bytes((address, command)) + answer) == 0 else None


def write_command(address: int, command: int, data: bytes = b"") -> bytes:
    """A command that changes something, as the host sends it."""
    body = bytes((address, command)) + data
    return body + struct.pack(">H", crc16(body))


def encode_counts(address: int, left: int, right: int) -> bytes:
    """The answer to `READ_ENCODERS`."""
    return sealed(bytes((address, READ_ENCODERS)), struct.pack(">II", left % 2**32, right % 2**32))


def decode_counts(address: int, answer: bytes) -> tuple[int, int] | None:
    """Both counters as signed numbers, or None when this is no such answer."""
    data = opened(address, READ_ENCODERS, answer)
    if data is None or len(data) != 8:
        return None
    left, right = struct.unpack(">ii", data)
    return left, right


class RoboClaw(Quiet):
    """`BaseProtocol`: asks for both counters; motor 1 is the left wheel."""

    baud_rates: tuple[int, ...] = BAUD_RATES
    poll_period_s = POLL_PERIOD_S

    def __init__(self, geometry: WheelGeometry, address: int = FIRST_ADDRESS) -> None:
        self.geometry = geometry
        self.counters = Counters()
        self._address = address
        self._pending = bytearray()

    def poll_request(self) -> bytes:
        """See `BaseProtocol`."""
        return bytes((self._address, READ_ENCODERS))

    def feed(self, data: bytes) -> list[TickSample]:
        """See `BaseProtocol`."""
        self.counters.bytes_in += len(data)
        self._pending += data
        samples = []
        while len(self._pending) >= ANSWER_BYTES:
            counts = decode_counts(self._address, bytes(self._pending[:ANSWER_BYTES]))
            if counts is None:
                del self._pending[0]
                self.counters.skip(1)
            else:
                del self._pending[:ANSWER_BYTES]
                self.counters.good()
                samples.append(TickSample(*counts, 32))
        return samples
