"""Named scalars and arrays as one block of bytes that notices when it is damaged.

magic "MQMC" | version u16 | sha256 of the rest | zlib( length u32 | JSON: scalars and array shapes | arrays, raw )
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from typing import Any

import numpy as np

MAGIC = b"MQMC"
VERSION = 4
LARGEST_BYTES = 1 << 30  # unpacked; a map of a square kilometre stays below
DTYPES = {"bool", "uint8", "uint16", "int8", "int16", "int32", "int64", "float32", "float64"}

State = dict[str, Any]  # name -> an array, or a scalar that JSON knows


class CheckpointError(ValueError):
    """These bytes are not a checkpoint that these options can go on from."""


def sealed(state: State) -> bytes:
    """The block."""
    scalars = {key: value for key, value in state.items() if not isinstance(value, np.ndarray)}
    arrays = {key: value for key, value in state.items() if isinstance(value, np.ndarray)}
    shapes = [[key, str(value.dtype), list(value.shape)] for key, value in arrays.items()]
    head = json.dumps({"scalars": scalars, "arrays": shapes}).encode()
    raw = (np.ascontiguousarray(array).tobytes() for array in arrays.values())
    body = zlib.compress(b"".join([struct.pack("<I", len(head)), head, *raw]), 1)
    return MAGIC + struct.pack("<H", VERSION) + hashlib.sha256(body).digest() + body


def opened(data: bytes) -> State:
    """Scalars and arrays by name."""
    if data[:4] != MAGIC:
        raise CheckpointError("the saved map does not begin like one")
    (version,) = struct.unpack("<H", data[4:6])
    if version != VERSION:
        raise CheckpointError(f"the saved map has format {version}, this program reads {VERSION}")
    if hashlib.sha256(data[38:]).digest() != data[6:38]:
        raise CheckpointError("the saved map is damaged: its checksum is wrong")
    unpacked = zlib.decompressobj().decompress(data[38:], LARGEST_BYTES)
    (length,) = struct.unpack("<I", unpacked[:4])
    head = json.loads(unpacked[4 : 4 + length])
    state: State = dict(head["scalars"])
    at = 4 + length
    for key, dtype, shape in head["arrays"]:
        if dtype not in DTYPES or any(not 0 <= n < LARGEST_BYTES for n in shape):
            raise CheckpointError(f"the saved map is damaged: array {key!r} of {dtype} {shape}")
        count = math.prod(shape)
        state[key] = np.frombuffer(unpacked, dtype, count, at).reshape(shape).copy()
        at += state[key].nbytes
    return state
