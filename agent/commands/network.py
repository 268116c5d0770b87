"""What commands share that are on the network without being a robot: how they stop, and what a network that is shut says."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from agent.commands.run import StopSignals
from agent.exits import PEER, USAGE, CommandError
from agent.runtime.exchange import ExchangeError
from agent.runtime.network import NetworkConfigError


@contextlib.contextmanager
def on_the_network() -> Iterator[threading.Event]:
    """An event that a signal sets; a network that cannot be opened is one sentence and an exit code."""
    stopping = threading.Event()
    StopSignals().then(stopping.set)
    try:
        yield stopping
    except NetworkConfigError as error:
        raise CommandError(str(error), USAGE) from error
    except ExchangeError as error:
        raise CommandError(str(error), PEER) from error
