"""A simulated SICK answers what other people's programs ask."""

from __future__ import annotations

import contextlib
import struct

import numpy as np
import pytest

from hw import sick_wire
from hw.driver import Ask
from hw.readings import LaserScan
from hw.sick_lms import SickLms
from hw.sim.sick_sim import SickSim
from tests.hw.test_sim_answers import answer, sight


def told(scanner: SickSim, payload: bytes) -> bytes:
    """The payload of the answer, behind the byte that acknowledges the request."""
    said = answer(scanner, sick_wire.encode(payload), 0.0)
    size = 7 + (said[3] | said[4] << 8)
    decoded = sick_wire.decode(said[1:size])
    assert said[0] == sick_wire.ACK and decoded is not None
    return decoded[1]


def test_a_sick_tells_what_it_is_and_how_it_is_set() -> None:
    scanner = SickSim(sight())
    assert told(scanner, sick_wire.TYPE)[1:11] == b"LMS291;S05"
    assert told(scanner, b"\x32") == b"\xb2\x10", "none"
    told(scanner, sick_wire.variant_request(100, 0.25))
    status = told(scanner, sick_wire.STATUS)
    assert struct.unpack_from("<HH", status, 107) == (100, 25)
    assert (status[8], status[122]) == (0x25, 1), "polled, in millimetres"


def test_a_sick_changes_its_unit_only_behind_its_password() -> None:
    scanner = SickSim(sight())
    config = bytearray(told(scanner, bytes((sick_wire.GET_CONFIG,)))[1:-1])
    assert len(config) == 34
    config[6] = 0
    wish = bytes((sick_wire.SET_CONFIG,)) + config
    assert told(scanner, wish)[1] == 0
    assert told(scanner, sick_wire.INSTALL[:-1] + b"X") == b"\xa0\x01\x10"
    assert told(scanner, sick_wire.INSTALL) == b"\xa0\x00\x10"
    assert told(scanner, wish)[1:-1] == b"\x01" + bytes(config)
    scan = sick_wire.ScanPayload.decode(told(scanner, sick_wire.ONE_SCAN))
    assert scan is not None and not scan.is_mm


def test_a_sick_answers_a_poll_with_a_scan_and_refuses_a_mode_it_has_not() -> None:
    scanner = SickSim(sight())
    scan = sick_wire.ScanPayload.decode(told(scanner, sick_wire.ONE_SCAN))
    assert scan is not None and len(scan.values) == 361
    assert told(scanner, b"\x20\x2e") == b"\xa0\x02\x10"


def test_the_parts_of_a_sick_scan_are_the_scan() -> None:
    scanner = SickSim(sight())
    whole = sick_wire.ScanPayload.decode(told(scanner, sick_wire.ONE_SCAN))
    told(scanner, bytes((sick_wire.MODE, sick_wire.RATE_CODES[500000])))
    told(scanner, sick_wire.PARTIAL)
    scanner.emit(5.0)
    stream = scanner.emit(5.1)
    first = struct.unpack_from("<H181H", stream, 5)
    second = struct.unpack_from("<H180H", stream, 10 + 2 * 181 + 5)
    assert (first[0], second[0]) == (181 | 0x6000, 180 | 0x6000 | 2 << 11)
    assert whole is not None
    assert np.array_equal(first[1:], whole.values[0::2]) and np.array_equal(second[1:], whole.values[1::2])


def test_a_sick_says_when_a_telegram_is_damaged_or_means_nothing_to_it() -> None:
    scanner = SickSim(sight())
    damaged = bytearray(sick_wire.encode(sick_wire.TYPE))
    damaged[-1] ^= 1
    assert answer(scanner, bytes(damaged), 0.0) == bytes((sick_wire.NAK,))
    assert answer(scanner, b"\x06\x02\x02" + sick_wire.encode(sick_wire.TYPE), 0.0)[:1] == bytes((sick_wire.ACK,))
    assert told(scanner, b"\x5e") == b"\x92\x10"
    scanner.receive(b"\x02\0\x20\0", 6.0)  # half of one, and nothing follows
    scanner.receive(sick_wire.encode(sick_wire.TYPE), 7.0)
    assert b"LMS291" in scanner.emit(7.0)


def test_a_sick_that_is_reset_wakes_at_9600_baud_and_says_so() -> None:
    scanner = SickSim(sight())
    told(scanner, bytes((sick_wire.MODE, sick_wire.RATE_CODES[38400])))
    told(scanner, sick_wire.CONTINUOUS)
    assert told(scanner, sick_wire.RESET) == b"\x91\x10"
    scanner.receive(sick_wire.encode(sick_wire.TYPE), 5.5)
    assert scanner.emit(5.9) == b"", "it boots"
    assert scanner.baud == 9600
    assert scanner.emit(6.1) == sick_wire.encode(b"\x90LMS291;S05;V02.10\x10", sick_wire.SCANNER_ADDRESS)


def test_a_sick_keeps_its_variant_when_it_is_asked_for_one_it_has_not() -> None:
    scanner = SickSim(sight())
    assert told(scanner, sick_wire.variant_request(100, 0.25)) == b"\xbb\x01\x64\0\x19\0\x10"
    assert told(scanner, sick_wire.variant_request(180, 0.25)) == b"\xbb\x00\x64\0\x19\0\x10"


def test_a_sick_sends_means_and_sectors_of_its_scans() -> None:
    scanner = SickSim(sight())
    whole = told(scanner, sick_wire.ONE_SCAN)
    assert told(scanner, b"\x36\x05") == b"\xb6\x05" + whole[1:]
    sector = told(scanner, b"\x37" + struct.pack("<HH", 101, 110))
    assert sector[1:5] == struct.pack("<HH", 101, 110)
    assert sector[7:-1] == whole[3 + 200 : 3 + 220]
    told(scanner, bytes((sick_wire.MODE, sick_wire.RATE_CODES[500000])))
    for wish, kind in ((b"\x26\x02", 0xB6), (b"\x27" + struct.pack("<HH", 1, 361), 0xB7)):
        assert told(scanner, b"\x20" + wish) == b"\xa0\x00\x10"
        scanner.emit(5.0)
        assert scanner.emit(5.1)[4] == kind
        told(scanner, sick_wire.POLLED)
        scanner.emit(5.0)
    assert told(scanner, b"\x20\x26") == b"\xa0\x02\x10", "means of how many?"


@pytest.mark.parametrize("deaf_to", [b"", b"\x74", b"\x74\x31"], ids=["answers all", "no configuration", "nor status"])
def test_the_driver_knows_what_the_flags_in_millimetres_are_when_it_is_told(deaf_to: bytes) -> None:
    scanner, driver = SickSim(sight()), SickLms()
    told(scanner, sick_wire.INSTALL)
    config = bytearray(told(scanner, bytes((sick_wire.GET_CONFIG,)))[1:-1])
    config[sick_wire.MEASURING_MODE_AT] = 0  # 8 m, and three field flags
    told(scanner, bytes((sick_wire.SET_CONFIG,)) + config)
    steps = driver.start()
    step = next(steps)
    with contextlib.suppress(StopIteration):
        while True:
            if isinstance(step, Ask):
                question = sick_wire.decode(step.data)
                if question is not None and question[1][:1] not in [deaf_to[k : k + 1] for k in range(len(deaf_to))]:
                    driver.feed(answer(scanner, step.data, 0.0), 5.0)
            step = steps.send(step.until() if isinstance(step, Ask) else None)
    flagged = sick_wire.scan_telegram([0x2000 | 3000] * 181, is_mm=True)
    (scan,) = driver.feed(flagged, 6.0)
    assert isinstance(scan, LaserScan)
    assert scan.ranges_m[0] == pytest.approx(11.192 if len(deaf_to) == 2 else 3.0)
