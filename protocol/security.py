"""The `shared` level of security: one secret a fleet, a message authentication code on every message, and no replays.

    | "MS" | 1 | n | sender (n) | boot u64 LE | counter u64 LE | HMAC-SHA256, first 16 bytes | payload ... |

The code covers everything before and behind it.  It proves that a holder of the fleet's secret wrote the bytes, and the
counter that they are not an old recording of this boot; it does not hide them, and it does not tell the members of the fleet
apart: that is what mutual TLS is for.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from collections import OrderedDict
from dataclasses import dataclass

from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.names import is_robot_id

MAGIC = b"MS\x01"
SEAL_BYTES = 68  # at most, around any payload
_MAC_BYTES = 16
_TAIL = struct.Struct("<QQ")
_WINDOW = 4_096  # how late a message may come, counted in messages of its sender
_MAX_LIVES = 2_048  # (sender, boot) that are remembered


@dataclass(frozen=True, slots=True)
class Sealed:
    """An opened seal: who says so, and what."""

    sender: str
    boot: int
    counter: int
    payload: bytes


def derive_key(secret: str, fleet: str) -> bytes:
    """32 bytes from what a person types; slow on purpose (16 MB, about 50 ms)."""
    if len(secret) < 8:
        raise LocalProtocolError(f"a fleet secret of {len(secret)} characters can be guessed; take 8 or more")
    return hashlib.scrypt(secret.encode(), salt=b"mapquilt/" + fleet.encode(), n=2**14, r=8, p=1, dklen=32)


def seal(key: bytes, sender: str, boot: int, counter: int, payload: bytes) -> bytes:
    """The payload under a code that only holders of the key can make; never use a counter twice in one boot."""
    name = sender.encode()
    head = MAGIC + bytes((len(name),)) + name + _TAIL.pack(boot, counter)
    return head + _code(key, head, payload) + payload


def unseal(key: bytes, data: bytes) -> Sealed:
    """What is inside, when the code is right; freshness is `ReplayWindow`'s business."""
    if len(data) < 4 or data[:3] != MAGIC:
        raise RemoteProtocolError("not sealed: this fleet has a secret, and the sender does not use it")
    end = 4 + data[3] + _TAIL.size
    if data[3] > 32 or len(data) < end + _MAC_BYTES:
        raise RemoteProtocolError("a seal that is cut off")
    head, code, payload = data[:end], data[end : end + _MAC_BYTES], data[end + _MAC_BYTES :]
    if not hmac.compare_digest(_code(key, head, payload), code):
        raise RemoteProtocolError("the seal is broken: another secret, or changed bytes")
    sender = head[4 : 4 + data[3]].decode("ascii", "replace")
    if not is_robot_id(sender):
        raise RemoteProtocolError("sealed by nobody with a name")
    boot, counter = _TAIL.unpack(head[4 + data[3] :])
    return Sealed(sender, boot, counter, payload)


def _code(key: bytes, head: bytes, payload: bytes) -> bytes:
    return hmac.new(key, head + payload, hashlib.sha256).digest()[:_MAC_BYTES]


class Sealer:
    """Seals everything one process says, counting."""

    def __init__(self, key: bytes, sender: str, boot: int) -> None:
        self._key, self._sender, self._boot, self._counter = key, sender, boot, 0

    def seal(self, payload: bytes) -> bytes:
        self._counter += 1
        return seal(self._key, self._sender, self._boot, self._counter, payload)


class ReplayWindow:
    """Remembers which messages came already: each (sender, boot, counter) is accepted once, and not when it is very late."""

    def __init__(self) -> None:
        self._seen: OrderedDict[tuple[str, int], tuple[int, int]] = OrderedDict()  # newest counter, bits of those before

    def accept(self, sealed: Sealed) -> bool:
        life = (sealed.sender, sealed.boot)
        newest, bits = self._seen.get(life, (0, 0))
        behind = newest - sealed.counter
        if behind >= _WINDOW or (behind >= 0 and bits >> behind & 1):
            return False
        if behind < 0:
            newest, bits = sealed.counter, (bits << min(-behind, _WINDOW) | 1) & ((1 << _WINDOW) - 1)
        else:
            bits |= 1 << behind
        self._seen[life] = (newest, bits)
        self._seen.move_to_end(life)
        while len(self._seen) > _MAX_LIVES:
            self._seen.popitem(last=False)
        return True


def open_seal(key: bytes, window: ReplayWindow, data: bytes) -> Sealed:
    """The payload of a message that is genuine and new; otherwise a `RemoteProtocolError`."""
    sealed = unseal(key, data)
    if not window.accept(sealed):
        raise RemoteProtocolError(f"a replay of message {sealed.counter} of {sealed.sender}")
    return sealed
