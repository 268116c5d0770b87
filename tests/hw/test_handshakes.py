"""Each LIDAR is woken as its manual says, by whatever state it is found in."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from hw import rplidar_wire, scip, sick_wire, ydlidar_wire
from hw.driver import Driver
from hw.health import DeviceHealth
from hw.hokuyo import Hokuyo
from hw.readings import LaserScan
from hw.rplidar import Rplidar
from hw.sick_lms import SickLms
from hw.supervisor import Device
from hw.ydlidar import YdLidar
from tests.harness.lidar_streams import STREAMS, Stream
from tests.harness.talking_port import TalkingPort

INFO = rplidar_wire.Info(0x18, (1, 29), 7, bytes(range(16)))


@pytest.fixture
def run() -> Iterator[Callable[[Driver, TalkingPort], Device]]:
    devices: list[Device] = []

    def start(driver: Driver, port: TalkingPort) -> Device:
        devices.append(Device("test:port", driver, port.open).start())
        return devices[-1]

    yield start
    for device in devices:
        device.stop()


def _first_scan(device: Device, seconds: float = 6.0) -> LaserScan:
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        scan = device.read(0.2)
        if scan is not None:
            assert isinstance(scan, LaserScan)
            return scan
    raise AssertionError(f"no scan: {device.health()}")


def _until(device: Device, holds: Callable[[DeviceHealth], bool], seconds: float = 5.0) -> DeviceHealth:
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        if holds(device.health()):
            return device.health()
        time.sleep(0.01)
    raise AssertionError(f"never: {device.health()}")


class FakeRplidar:
    """An RPLIDAR as far as the driver asks."""

    def __init__(
        self, info: rplidar_wire.Info = INFO, health: int = 0, express: Stream | None = None, typical: int = 0x82
    ) -> None:
        self.info, self.health, self.express, self.typical = info, health, express, typical
        self.nodes = STREAMS["rplidar-0x81"](seconds=1.0)

    def __call__(self, port: TalkingPort, data: bytes) -> None:
        request, _ = rplidar_wire.parse_request(data)
        assert request is not None, data.hex()
        single = {
            rplidar_wire.INFO_CMD: (rplidar_wire.INFO_TYPE, self.info.encode()),
            rplidar_wire.HEALTH_CMD: (rplidar_wire.HEALTH_TYPE, rplidar_wire.Health(self.health).encode()),
            rplidar_wire.BOARD_FLAG_CMD: (rplidar_wire.BOARD_FLAG_TYPE, b"\x01\0\0\0"),
        }
        if request.command in single:
            port.say(rplidar_wire.answer(*single[request.command]))
        elif request.command == rplidar_wire.STOP_CMD:
            port.silence()
        elif request.command == rplidar_wire.RESET_CMD:
            self.health = 0
            port.say(b"RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 7\r\nModel: 18\r\n")
        elif request.command == rplidar_wire.SCAN_CMD:
            self._scan(port, self.nodes)
        elif request.command == rplidar_wire.EXPRESS_CMD and self.express is not None:
            self._scan(port, self.express)
        elif request.command == rplidar_wire.GET_CONF_CMD and self.express is not None:
            self._conf(port, request.payload)

    def _conf(self, port: TalkingPort, payload: bytes) -> None:
        key = int.from_bytes(payload[:4], "little")
        values = {
            rplidar_wire.CONF_TYPICAL_MODE: b"\x02\x00",
            rplidar_wire.CONF_ANSWER_TYPE: bytes((self.typical,)),
            rplidar_wire.CONF_MODE_COUNT: b"\x03\x00",
        }
        port.say(rplidar_wire.answer(rplidar_wire.CONF_TYPE, rplidar_wire.Conf(key, values[key]).encode()))

    def _scan(self, port: TalkingPort, stream: Stream) -> None:
        port.say(stream.prefix)
        port.stream(stream.data, stream.bytes_per_s)


def test_an_rplidar_left_scanning_is_silenced_identified_and_started(run) -> None:
    fake = FakeRplidar()
    port = TalkingPort(fake)
    port.stream(fake.nodes.data, fake.nodes.bytes_per_s)
    device = run(Rplidar(mode="standard"), port)
    assert len(_first_scan(device).ranges_m) == 400
    health = device.health()
    assert (health.model, health.firmware, health.serial) == ("RPLIDAR A1M8", "1.29", bytes(range(16)).hex().upper())
    assert port.heard[0] == rplidar_wire.request(rplidar_wire.STOP_CMD)
    assert (False, None) in port.lines, "DTR down starts the motor of an A1"
    device.stop()
    assert port.heard[-2:] == [rplidar_wire.request(rplidar_wire.STOP_CMD), rplidar_wire.request(rplidar_wire.PWM_CMD, b"\0\0")]
    assert port.lines[-1] == (True, None)


@pytest.mark.parametrize("kind", [0x82, 0x84, 0x85, 0x86])
def test_the_typical_mode_is_taken_where_the_device_has_a_list(run, kind: int) -> None:
    stream = STREAMS[f"rplidar-{kind:#x}"](seconds=1.0)
    port = TalkingPort(FakeRplidar(express=stream, typical=kind))
    driver = Rplidar()
    _first_scan(run(driver, port))
    assert driver.scan_type == kind
    assert rplidar_wire.express_request(2) in port.heard


def test_a_typical_mode_that_is_the_standard_scan_is_asked_for_by_its_own_request(run) -> None:
    port = TalkingPort(FakeRplidar(express=STREAMS["rplidar-0x82"](seconds=1.0), typical=0x81))
    driver = Rplidar()
    _first_scan(run(driver, port))
    assert driver.scan_type == rplidar_wire.NODE_TYPE


def test_an_express_mode_that_is_refused_gives_way_to_the_standard_scan(run) -> None:
    old = rplidar_wire.Info(0x18, (1, 20), 0, bytes(16))
    driver = Rplidar()
    _first_scan(run(driver, TalkingPort(FakeRplidar(old))))
    assert driver.scan_type == rplidar_wire.NODE_TYPE


def test_a_protection_stop_is_reset_once(run) -> None:
    port = TalkingPort(FakeRplidar(health=2))
    _first_scan(run(Rplidar(mode="standard"), port), 8.0)
    assert port.heard.count(rplidar_wire.request(rplidar_wire.RESET_CMD)) == 1


def test_an_rplidar_is_found_at_its_own_rate(run) -> None:
    device = run(Rplidar(mode="standard"), TalkingPort(FakeRplidar(), works_at=(460800,)))
    _first_scan(device, 8.0)
    assert device.health().baud == 460800


def test_no_answer_says_what_to_try(run) -> None:
    driver = Rplidar()
    driver.bauds = (115200,)
    device = run(driver, TalkingPort())
    health = _until(device, lambda h: "GET_INFO" in h.last_error, 8.0)
    assert "is it powered" in health.last_error


class FakeHokuyo:
    """A UTM-30LX that refuses to light its laser a few times while it boots."""

    def __init__(self, refusals: int = 0) -> None:
        self.refusals = refusals
        self.stream = STREAMS["hokuyo-utm"](seconds=1.0)

    def __call__(self, port: TalkingPort, data: bytes) -> None:
        line = data.strip()
        if line == b"QT":
            port.silence()
            port.say(scip.encode_message(b"QT"))
        elif line == b"SCIP2.0":
            port.say(scip.encode_message(b"SCIP2.0", b"0E"))
        elif line == b"PP":
            port.say(self.stream.prefix)
        elif line == b"VV":
            port.say(scip.encode_message(b"VV", b"00", [b"VEND:Hokuyo Automatic Co.,Ltd.;", b"SERI:H0906091;", b"FIRM:1.18.01;"]))
        elif line == b"BM":
            port.say(scip.encode_message(b"BM", b"10" if self.refusals else b"00"))
            self.refusals -= self.refusals > 0
        elif line.startswith(b"MD"):
            port.say(scip.encode_message(line))
            port.stream(self.stream.data, self.stream.bytes_per_s)


def test_a_hokuyo_that_still_boots_is_waited_for(run) -> None:
    device = run(Hokuyo(), TalkingPort(FakeHokuyo(refusals=3)))
    assert len(_first_scan(device).ranges_m) == 1081
    health = device.health()
    assert (health.model, health.serial, health.firmware) == ("Hokuyo UTM-30LX", "H0906091", "1.18.01")


class FakeSick:
    """An LMS291 at some rate, which it changes when it is told."""

    def __init__(self) -> None:
        self.stream = STREAMS["sick"](seconds=1.0)

    def __call__(self, port: TalkingPort, data: bytes) -> None:
        decoded = sick_wire.decode(data)
        assert decoded is not None
        payload = decoded[1]
        rates = {code: baud for baud, code in sick_wire.RATE_CODES.items()}
        if payload == sick_wire.TYPE:
            self._answer(port, b"\xbaLMS291;V02.10\x10")
        elif payload == sick_wire.POLLED:
            port.silence()
            self._answer(port, b"\xa0\x00\x10")
        elif payload == sick_wire.CONTINUOUS:
            self._answer(port, b"\xa0\x00\x10")
            port.stream(self.stream.data, 10 * self.stream.bytes_per_s)
        elif payload[0] == sick_wire.MODE:
            self._answer(port, b"\xa0\x00\x10")
            port._works_at = (rates[payload[1]],)
            with port._lock:  # what is said so far still goes out at the old rate
                port._queue[:] = bytes(b ^ 0 for b in port._queue)

    def _answer(self, port: TalkingPort, payload: bytes) -> None:
        port.say(bytes((sick_wire.ACK,)) + sick_wire.encode(payload, sick_wire.SCANNER_ADDRESS))


class SlowSick(FakeSick):
    """Changes its rate only after its answer was read, as a UART does."""

    def __call__(self, port: TalkingPort, data: bytes) -> None:
        works_at = port._works_at
        super().__call__(port, data)
        if port._works_at != works_at:
            new, port._works_at = port._works_at, works_at
            original = port.set_baud

            def set_baud(baud: int) -> None:
                port._works_at = new
                original(baud)

            port.set_baud = set_baud  # type: ignore[method-assign]


def test_a_sick_at_9600_is_found_and_moved_to_the_rate_asked_for(run) -> None:
    port = TalkingPort(SlowSick(), works_at=(9600,))
    device = run(SickLms(rate=38400), port)
    assert len(_first_scan(device, 12.0).ranges_m) == 361
    assert (device.health().model, device.health().baud) == ("SICK LMS291", 38400)
    assert 9600 in port.bauds
    assert device.health().skipped_bytes == 0, "the byte that acknowledges a request is no damage"


class FakeYdLidar:
    """A G2 that answers; or, one-way, an X2 that only streams."""

    def __init__(self) -> None:
        self.stream = STREAMS["ydlidar-3B"](seconds=1.0)

    def __call__(self, port: TalkingPort, data: bytes) -> None:
        if data == ydlidar_wire.command(ydlidar_wire.STOP):
            port.silence()
        elif data == ydlidar_wire.command(ydlidar_wire.INFO):
            port.say(ydlidar_wire.answer(ydlidar_wire.INFO_TYPE, ydlidar_wire.info_body(15, (1, 5), 1, [2, 0, 1, 9] * 4)))
        elif data == ydlidar_wire.command(ydlidar_wire.HEALTH):
            port.say(ydlidar_wire.answer(ydlidar_wire.HEALTH_TYPE, b"\0\0\0"))
        elif data == ydlidar_wire.command(ydlidar_wire.SCAN):
            port.say(b"\xa5\x5a\x05\x00\x00\x40\x81")
            port.stream(self.stream.data, self.stream.bytes_per_s)


def test_a_two_way_ydlidar_tells_its_model_and_scans(run) -> None:
    device = run(YdLidar(), TalkingPort(FakeYdLidar(), works_at=(230400,)))
    assert len(_first_scan(device, 8.0).ranges_m) == 501
    assert (device.health().model, device.health().serial[:4], device.health().baud) == ("YDLIDAR G2", "2019", 230400)


def test_a_one_way_ydlidar_just_streams(run) -> None:
    stream = STREAMS["ydlidar-2B"](seconds=1.0)
    port = TalkingPort(works_at=(115200,))
    port.stream(stream.data, stream.bytes_per_s)
    device = run(YdLidar("x2"), port)
    _first_scan(device)
    assert port.heard == [], "it hears nothing anyway"
