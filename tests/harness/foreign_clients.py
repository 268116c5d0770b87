"""Other people's client libraries, each made to print what it read: run by an interpreter that has them, not by ours.

    PYTHON tests/harness/foreign_clients.py CLIENT PORT MODE BAUD

LIDAR clients print a JSON list of [degrees counter-clockwise, metres], clients of wheel bases one of
[seconds, left, right] with counters in ticks.
Nothing of mapquilt is imported here.  The clients run as they are; only pyserial is told that a pseudo-terminal has no modem
lines, which clients that drive a motor by DTR take for a broken port.
"""

# ruff: noqa: PLC0415  a client imports its own library, as the others need not be there
from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import math
import os
import socket
import sys
import threading
import time
import types
from collections.abc import Callable

import serial

Rows = list[list[float]]
BEAMS = 3000


def rplidar_roboticia(port: str, mode: str, baud: int) -> Rows:
    from rplidar import RPLidar

    lidar = RPLidar(port, baud)
    lidar.get_info()
    lidar.get_health()
    scans = list(itertools.islice(lidar.iter_scans(mode, max_buf_meas=False), 4))
    lidar.stop()
    return [[-angle, mm / 1e3] for scan in scans[1:] for _, angle, mm in scan]


def adafruit_rplidar(port: str, mode: str, baud: int) -> Rows:
    from adafruit_rplidar import RPLidar

    lidar = RPLidar(None, port, baud, timeout=3)
    assert lidar.health[0] == "Good" and lidar.info["model"], "no answer to who are you"
    scan = {"normal": 0, "express": 2}[mode]
    beams = itertools.islice(lidar.iter_measurements(max_buf_meas=0, scan_type=scan), BEAMS)
    rows = [[-angle, mm / 1e3] for _, _, angle, mm in beams]
    lidar.stop()
    return rows


def rplidarc1(port: str, mode: str, baud: int) -> Rows:
    from rplidarc1 import RPLidar

    async def read() -> Rows:
        lidar = RPLidar(port, baud)
        scan = asyncio.create_task(lidar.simple_scan())
        rows = []
        while len(rows) < BEAMS:
            beam = await asyncio.wait_for(lidar.output_queue.get(), 5)
            if beam["d_mm"]:
                rows.append([-beam["a_deg"], beam["d_mm"] / 1e3])
        lidar.stop_event.set()
        await scan
        return rows

    return asyncio.run(read())


def pyrplidar(port: str, mode: str, baud: int) -> Rows:
    from pyrplidar import PyRPlidar

    lidar = PyRPlidar()
    lidar.connect(port=port, baudrate=baud, timeout=3)
    lidar.get_info()
    lidar.get_health()
    lidar.get_samplerate()
    scan = lidar.start_scan() if mode == "standard" else lidar.start_scan_express(int(mode))
    rows = [[-m.angle, m.distance / 1e3] for m in itertools.islice(scan(), BEAMS)]
    lidar.stop()
    return rows


def pyrplidarsdk(port: str, mode: str, baud: int) -> Rows:
    from pyrplidarsdk import RplidarDriver

    lidar = RplidarDriver(port=port, baudrate=baud)
    assert lidar.connect(), "the maker's SDK does not connect"
    assert lidar.get_device_info() and lidar.get_health(), "no answer to who are you"
    assert lidar.start_scan(), "the maker's SDK does not start a scan"
    scans = []
    deadline_s = time.monotonic() + 10
    while len(scans) < 4 and time.monotonic() < deadline_s:
        scans += filter(None, [lidar.get_scan_data()])
    lidar.stop_scan()
    lidar.disconnect()
    return [[-math.degrees(a), r] for angles, ranges, _ in scans[1:] for a, r in zip(angles, ranges, strict=True)]


def lds2d(port: str, mode: str, baud: int) -> Rows:
    from lds2d import Lidar, NotSupportedError

    still = types.SimpleNamespace(set_duty=lambda duty: None, close=lambda: None)  # the XV-11's host drives its motor
    lidar = Lidar.open(mode, port, **({"motor": still} if mode == "XV11" else {}))
    with contextlib.suppress(NotSupportedError):
        lidar.start()
    return [[-p.angle_deg, p.dist_mm / 1e3] for p in itertools.islice(lidar.points(), BEAMS)]


def pylidar3(port: str, mode: str, baud: int) -> Rows:
    import PyLidar3

    lidar = getattr(PyLidar3, mode)(port)
    assert lidar.Connect(), "no health answer"
    assert lidar.GetDeviceInfo()["model_number"], "no answer to who are you"
    turns = list(itertools.islice(lidar.StartScanning(), 3))
    lidar.StopScanning()
    return [[-(degree + 0.5), mm / 1e3] for turn in turns[1:] for degree, mm in turn.items() if mm]  # means over whole degrees


def hokuyolx(port: str, mode: str, baud: int) -> Rows:
    """Speaks SCIP over TCP only, so the port is put behind a socket; it cannot part two scans, so some are left out."""
    from hokuyolx import HokuyoLX

    with socket.create_server(("127.0.0.1", 0)) as server, serial.Serial(port, baud or 115200, timeout=0.01) as line:
        threading.Thread(target=relay, args=(server, line), daemon=True).start()
        lidar = HokuyoLX(addr=server.getsockname(), time_tolerance=10**9)
        lidar.update_info()
        if mode == "GD":
            scans = [lidar.get_dist()[1] for _ in range(3)]
        elif mode == "GE":
            scans = [lidar.get_intens()[1][:, 0] for _ in range(3)]
        elif mode == "ME":
            scans = [scan[:, 0] for scan, *_ in itertools.islice(lidar.iter_intens(scans=3, skips=4), 3)]
        else:
            scans = [scan for scan, *_ in itertools.islice(lidar.iter_dist(scans=3, skips=4), 3)]
        angles = lidar.get_angles()
        lidar.standby()
        return [[math.degrees(a), mm / 1e3] for scan in scans for a, mm in zip(angles, scan, strict=True)]


def relay(server: socket.socket, line: serial.Serial) -> None:
    """Bytes between one TCP client and a serial port, until the client goes."""
    client, _ = server.accept()
    client.settimeout(0.005)
    with contextlib.suppress(OSError, serial.SerialException):
        while True:
            with contextlib.suppress(TimeoutError):
                line.write(client.recv(4096))
            if waiting := line.in_waiting:
                client.sendall(line.read(waiting))


def ticks(read: Callable[[], list[float]], await_news: Callable[[], None] = lambda: None) -> Rows:
    """Readings of both counters over a few seconds, each with its time."""
    rows = []
    for _ in range(60):
        await_news()
        rows.append([time.time(), *read()])
        time.sleep(0.08)
    return rows


def pycreate2(port: str, mode: str, baud: int) -> Rows:
    from pycreate2 import Create2

    robot = Create2(port)
    robot.start()
    robot.safe()
    if mode == "drive":
        robot.drive_direct(150, 100)  # right, left, mm/s

    def read() -> list[float]:
        sensors = robot.get_sensors()
        assert sensors.open_interface_mode == 2, "not in safe mode"
        return [sensors.encoder_counts_left, sensors.encoder_counts_right]

    return ticks(read)


def yarc(port: str, mode: str, baud: int) -> Rows:
    from yarc import Roomba
    from yarc.sensor import Sensor

    robot = Roomba(port)
    robot.start()
    robot.safe()
    if mode == "drive":
        robot.drive_direct(150, 100)  # right, left, mm/s
    wanted = [Sensor.LEFT_ENCODER_COUNTS, Sensor.RIGHT_ENCODER_COUNTS]
    return ticks(lambda: [count % 65536 for count in robot.query_list(*wanted)])


def create_serial(port: str, mode: str, baud: int) -> Rows:
    from create_serial.create import ENCODER_LEFT, ENCODER_RIGHT, Create

    robot = Create(port)
    return ticks(lambda: [robot.sensors([which])[which] for which in (ENCODER_LEFT, ENCODER_RIGHT)])


def kobukidriver(port: str, mode: str, baud: int) -> Rows:
    """Looks for its port by the name of the adapter, and never ends by itself."""
    import serial.tools.list_ports as ports
    from kobukidriver import Kobuki

    ports.comports = lambda: [(port, "Kobuki", "")]
    robot = Kobuki()
    time.sleep(0.5)

    def read() -> list[float]:
        sensors = robot.basic_sensor_data()
        assert sensors["Charger"] == "DISCHARGING" and sensors["Batteryvolt"] == 160, "not where the battery should be"
        return [int.from_bytes(bytes(sensors[side]), "little") for side in ("Left_encoder", "Right_encoder")]

    def await_news() -> None:
        deadline_s, before = time.monotonic() + 0.2, read()
        while read() == before and time.monotonic() < deadline_s:
            time.sleep(0.001)

    return ticks(read, await_news)


def basicmicro(port: str, mode: str, baud: int) -> Rows:
    from basicmicro import Basicmicro

    board = Basicmicro(port, 38400)
    assert board.Open(), "the port does not open"
    assert board.ReadVersion(0x80)[0], "no version"
    assert board.ReadMainBatteryVoltage(0x80) == (True, 124), "no voltage"
    ticks_per_m = 2048 / (math.tau * 0.05)
    speeds_mps = (0.10, 0.15) if mode == "drive" else (0.01, -0.01)
    assert board.SpeedM1M2(0x80, *(round(v * ticks_per_m) for v in speeds_mps)), "no answer to a speed"

    def read() -> list[float]:
        is_read, left, right = board.GetEncoders(0x80)
        (is_left, one, _), (is_right, two, _) = board.ReadEncM1(0x80), board.ReadEncM2(0x80)
        assert is_read and is_left and is_right, "an encoder is not read"
        assert abs(one - left) < 2000 and abs(two - right) < 2000, "two ways to read, two counts"
        return [left, right]

    return ticks(read)


CLIENTS: dict[str, Callable[[str, str, int], Rows]] = {
    "rplidar-roboticia": rplidar_roboticia,
    "adafruit-rplidar": adafruit_rplidar,
    "rplidarc1": rplidarc1,
    "pyrplidar": pyrplidar,
    "pyrplidarsdk": pyrplidarsdk,
    "lds2d": lds2d,
    "pylidar3": pylidar3,
    "hokuyolx": hokuyolx,
    "pycreate2": pycreate2,
    "yarc": yarc,
    "create-serial": create_serial,
    "basicmicro": basicmicro,
    "kobukidriver": kobukidriver,
}


def main() -> None:
    client, port, mode, baud = sys.argv[1:]
    serial.Serial._update_dtr_state = serial.Serial._update_rts_state = lambda self: None
    with contextlib.redirect_stdout(sys.stderr):
        rows = CLIENTS[client](port, mode, int(baud))
    print(json.dumps(rows), flush=True)
    os._exit(0)  # some leave threads behind that read for ever


if __name__ == "__main__":
    main()
