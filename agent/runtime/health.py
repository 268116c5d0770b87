"""Is everything making progress?  The watchdog is fed only when every worker is.

systemd's protocol is one datagram to a unix socket (sd_notify(3)); without systemd nothing is sent.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Sequence

from agent.runtime.worker import WorkerReport


class Notifier:
    """Speaks to the service manager, when there is one."""

    def __init__(self, address: str | None = None) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET") if address is None else address

    def send(self, message: str) -> None:
        if not self._address:
            return
        name = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
                sock.connect(name)
                sock.sendall(message.encode())
        except OSError:
            return  # the manager is gone: nothing to tell anybody


def watchdog_period_s() -> float:
    """Half of what systemd allows between two signs of life; 1 s when it does not watch."""
    usec = os.environ.get("WATCHDOG_USEC", "")
    return max(0.05, min(1.0, int(usec) / 2e6)) if usec.isdigit() else 1.0


class Health:
    """Watches the workers' progress and feeds the watchdog."""

    def __init__(self, reports: Callable[[], Sequence[WorkerReport]], notifier: Notifier) -> None:
        self._reports = reports
        self._notifier = notifier
        self.stuck: tuple[str, ...] = ()

    def look(self, summary: str) -> bool:
        """Feed the watchdog when no worker is stuck; True then."""
        self.stuck = tuple(report.name for report in self._reports() if report.is_stuck)
        status = f"stuck: {', '.join(self.stuck)}" if self.stuck else summary
        self._notifier.send(f"STATUS={status}" + ("" if self.stuck else "\nWATCHDOG=1"))
        return not self.stuck
