"""A simulated device behind a serial port with modem lines, reached by `rfc2217://`: what a pseudo-terminal cannot be."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time

import serial
import serial.rfc2217

from hw.sim.devices import ByteDevice


class ModemLines:
    """Use it in a `with`; `url` is the port, `dtr` what its client last made of that line, `raised` how it changed."""

    def __init__(self, device: ByteDevice) -> None:
        self._device = device
        self._server = socket.create_server(("127.0.0.1", 0))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="serial port server", daemon=True)
        self.dtr = True  # as an adapter has it before anybody says otherwise
        self.changes: list[bool] = []

    @property
    def url(self) -> str:
        """What pyserial opens."""
        return f"rfc2217://127.0.0.1:{self._server.getsockname()[1]}"

    def __enter__(self) -> ModemLines:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stop.set()
        self._server.close()
        self._thread.join()

    def set_dtr(self, is_raised: bool) -> None:
        """The client says so."""
        self.dtr = is_raised
        self.changes.append(is_raised)
        self._device.set_lines(is_raised, True, time.monotonic())  # type: ignore[attr-defined]

    def _run(self) -> None:
        self._server.settimeout(0.05)
        while not self._stop.is_set():
            with contextlib.suppress(OSError):
                client, _ = self._server.accept()
                with client:
                    self._serve(client)

    def _serve(self, client: socket.socket) -> None:
        manager = serial.rfc2217.PortManager(_Settings(self), _Connection(client), logging.getLogger("ignored"))
        client.settimeout(0.005)
        while not self._stop.is_set():
            with contextlib.suppress(TimeoutError):
                if not (data := client.recv(4096)):
                    return
                self._device.receive(b"".join(manager.filter(data)), time.monotonic())
            if out := self._device.emit(time.monotonic()):
                client.sendall(b"".join(manager.escape(out)))


class _Connection:
    """What `PortManager` writes its own answers to."""

    def __init__(self, client: socket.socket) -> None:
        self._client = client

    def write(self, data: bytes) -> None:
        self._client.sendall(data)


class _Settings(serial.SerialBase):
    """What `PortManager` takes for a serial port: it keeps settings and hands DTR on."""

    cts = dsr = cd = True
    ri = False

    def __init__(self, lines: ModemLines) -> None:
        self._lines: ModemLines | None = None
        super().__init__()
        self._lines = lines

    def _reconfigure_port(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    @property
    def dtr(self) -> bool:
        return self._lines is None or self._lines.dtr

    @dtr.setter
    def dtr(self, value: bool) -> None:
        if self._lines is not None:
            self._lines.set_dtr(value)

    def reset_input_buffer(self) -> None:
        pass

    def reset_output_buffer(self) -> None:
        pass
