"""XXH3-128 with seed 0, of 17 bytes or more: rmw_zenoh names an endpoint by the hash of its liveliness key.

After the specification (xxHash, doc/xxhash_spec.md): up to 240 bytes are folded 32 at a time, up to 128 from both ends to the
middle; longer ones run through eight accumulators in stripes of 64 bytes.  Arithmetic is modulo 2^64.
"""

from __future__ import annotations

import struct

SECRET = bytes.fromhex(
    "b8fe6c3923a44bbe7c01812cf721ad1cded46de9839097db7240a4a4b7b3671fcb79e64eccc0e578825ad07dccff7221b8084674f743248ee03590e6813a264c"
    "3c2852bb91c300cb88d0658b1b532ea371644897a20df94e3819ef46a9deacd8a8fa763fe39c343ff9dcbbc7c70b4f1d8a51e04bcdb45931c89f7ec9d9787364"
    "eac5ac8334d3ebc3c581a0fffa1363eb170ddd51b7f0da49d316552629d4689e2b16be587d47a1fc8ff8b8d17ad031ce45cb3a8f95160428afd7fbcabb4b407e"
)
P32_1, P32_2, P32_3 = 0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D
P64_1, P64_2, P64_3 = 0x9E3779B185EBCA87, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9
P64_4, P64_5 = 0x85EBCA77C2B2AE63, 0x27D4EB2F165667C5
MASK = (1 << 64) - 1
STRIPE, SHORT, MIDDLE = 64, 128, 240  # bytes
STRIPES_A_BLOCK = (len(SECRET) - STRIPE) // 8


def xxh3_128(data: bytes) -> bytes:
    """16 bytes: the low word, then the high word, both little-endian."""
    if len(data) < 17:
        raise ValueError(f"{len(data)} bytes: only 17 and more are hashed here")
    low, high = _long(data) if len(data) > MIDDLE else _folded(data)
    return struct.pack("<QQ", low, high)


def _folded(data: bytes) -> tuple[int, int]:
    """Up to 240 bytes: 32 at a time into two sums."""
    n = len(data)
    low, high = n * P64_1 & MASK, 0
    if n <= SHORT:
        for i in reversed(range((n - 1) // 32 + 1)):
            low, high = _mix(low, high, data[16 * i :], data[n - 16 * (i + 1) :], 32 * i)
    else:
        for i in range(4):
            low, high = _mix(low, high, data[32 * i :], data[32 * i + 16 :], 32 * i)
        low, high = _avalanche(low), _avalanche(high)
        for i in range(4, n // 32):
            low, high = _mix(low, high, data[32 * i :], data[32 * i + 16 :], 3 + 32 * (i - 4))
        low, high = _mix(low, high, data[-16:], data[-32:], 136 - 17 - 16)
    total = low + high & MASK
    return _avalanche(total), -_avalanche((low * P64_1 + high * P64_4 + n * P64_2) & MASK) & MASK


def _long(data: bytes) -> tuple[int, int]:
    """More than 240 bytes: stripes into eight sums, which are scrambled after every block."""
    n = len(data)
    sums = [P32_3, P64_1, P64_2, P64_3, P64_4, P32_2, P64_5, P32_1]
    for i in range((n - 1) // STRIPE):
        _add_stripe(sums, data, STRIPE * i, 8 * (i % STRIPES_A_BLOCK))
        if i % STRIPES_A_BLOCK == STRIPES_A_BLOCK - 1:
            key = struct.unpack_from("<8Q", SECRET, len(SECRET) - STRIPE)
            sums[:] = [((s ^ s >> 47 ^ k) * P32_1) & MASK for s, k in zip(sums, key, strict=True)]
    _add_stripe(sums, data, n - STRIPE, len(SECRET) - STRIPE - 7)
    return _merged(sums, 11, n * P64_1 & MASK), _merged(sums, len(SECRET) - STRIPE - 11, ~(n * P64_2) & MASK)


def _add_stripe(sums: list[int], data: bytes, at: int, key_at: int) -> None:
    values, key = struct.unpack_from("<8Q", data, at), struct.unpack_from("<8Q", SECRET, key_at)
    for i, (value, k) in enumerate(zip(values, key, strict=True)):
        mixed = value ^ k
        sums[i ^ 1] = sums[i ^ 1] + value & MASK
        sums[i] = sums[i] + (mixed & 0xFFFFFFFF) * (mixed >> 32) & MASK


def _merged(sums: list[int], key_at: int, start: int) -> int:
    key = struct.unpack_from("<8Q", SECRET, key_at)
    return _avalanche((start + sum(_fold(sums[i] ^ key[i], sums[i + 1] ^ key[i + 1]) for i in (0, 2, 4, 6))) & MASK)


def _mix(low: int, high: int, one: bytes, other: bytes, key_at: int) -> tuple[int, int]:
    """16 bytes of each into the two sums."""
    a, b = struct.unpack_from("<QQ", one)
    c, d = struct.unpack_from("<QQ", other)
    k = struct.unpack_from("<4Q", SECRET, key_at)
    low = (low + _fold(a ^ k[0], b ^ k[1])) & MASK ^ (c + d & MASK)
    high = (high + _fold(c ^ k[2], d ^ k[3])) & MASK ^ (a + b & MASK)
    return low, high


def _fold(a: int, b: int) -> int:
    product = a * b
    return product & MASK ^ product >> 64


def _avalanche(h: int) -> int:
    h ^= h >> 37
    h = h * 0x165667919E3779F9 & MASK
    return h ^ h >> 32
