"""What pulls are answered: the message itself, or, when it is larger than one push, a manifest of its pieces."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TypeVar

from protocol.channels import CHUNK_BYTES, MAX_PUSH_BYTES
from protocol.codec import encode
from protocol.messages import NO_DIGEST, Chunk, Manifest, Message

_KEPT_BLOBS = 16
_KEPT_ANSWERS = 32

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Answers:
    """Encoded answers, and the large ones whole, by their hash, until newer ones need the room."""

    def __init__(self, robot: str, boot: int) -> None:
        self._robot, self._boot = robot, boot
        self._blobs: OrderedDict[bytes, bytes] = OrderedDict()
        self._kept: OrderedDict[Hashable, tuple[bytes, bytes]] = OrderedDict()  # (answer, hash of its blob if it has one)

    def to(self, message: Message) -> bytes:
        """The message encoded, or the manifest of its pieces."""
        return self._answer(message)[0]

    def kept(self, name: Hashable, make: Callable[[], Message]) -> bytes:
        """The same for a message that many pull: made once, and again when its pieces have given way."""
        known = self._kept.get(name)
        if known is None or (known[1] and known[1] not in self._blobs):
            known = self._answer(make())
            _keep(self._kept, name, known, _KEPT_ANSWERS)
        return known[0]

    def chunk(self, digest: bytes, index: int) -> bytes | None:
        """One piece of a large answer."""
        data = self._blobs.get(digest)
        if data is None or not 0 <= index * CHUNK_BYTES < len(data):
            return None
        piece = data[index * CHUNK_BYTES : (index + 1) * CHUNK_BYTES]
        return encode(Chunk(self._robot, self._boot, digest, index, piece))

    def _answer(self, message: Message) -> tuple[bytes, bytes]:
        data = encode(message)
        if len(data) <= MAX_PUSH_BYTES:
            return data, NO_DIGEST
        digest = hashlib.sha256(data).digest()
        _keep(self._blobs, digest, data, _KEPT_BLOBS)
        return encode(Manifest(self._robot, self._boot, digest, len(data), CHUNK_BYTES)), digest


def _keep(kept: OrderedDict[K, V], name: K, value: V, most: int) -> None:
    """As the newest; the oldest gives way."""
    kept[name] = value
    kept.move_to_end(name)
    while len(kept) > most:
        kept.popitem(last=False)
