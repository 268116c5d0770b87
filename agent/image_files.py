"""PGM and PNG images of maps: the size is known from the header, and refused, before a pixel is decoded.

P5 <width> <height> <maxval> <one whitespace> <pixels>      P2: the same, pixels as numbers; # starts a comment
89 'PNG' ... IHDR <width:u32> <height:u32> <depth:u8> ...
"""

from __future__ import annotations

import re
import stat
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_PIXELS = 2**27  # 11585 x 11585: 579 m squared at 5 cm; beyond, decoding alone takes gigabytes
MAX_FILE_BYTES = 2 * MAX_PIXELS + 4096  # 16-bit PGM is the largest there is
Pixels = NDArray[Any]  # (H, W) or (H, W, C) uint8 or uint16, first row on top
_PGM = re.compile(rb"P([25])(?:\s|#[^\r\n]*[\r\n])+(\d{1,9})(?:\s|#[^\r\n]*[\r\n])+(\d{1,9})(?:\s|#[^\r\n]*[\r\n])+(\d{1,5})\s")


class ImageFileError(Exception):
    """An image that cannot be read: says which, what was seen, and what to try."""


def load_image(path: Path) -> Pixels:
    """(H, W) or (H, W, C) uint8 or uint16, first row on top, full scale; C as cv2 orders it (BGR, BGRA)."""
    try:
        found = path.stat()
        if not (stat.S_ISREG(found.st_mode) or stat.S_ISDIR(found.st_mode)):  # /dev/zero has no end
            raise ImageFileError(f"{path}: no file but a device or a pipe; save the image to a file first")
        if found.st_size > MAX_FILE_BYTES:
            raise ImageFileError(f"{path}: {found.st_size} bytes are more than any map image has")
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        raise ImageFileError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    if data[:2] in (b"P5", b"P2"):
        return decode_pgm(data, path)
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return decode_png(data, path)
    if not data:
        raise ImageFileError(f"{path}: an empty file; was the disk full?")
    raise ImageFileError(f"{path}: neither PGM nor PNG (it starts with {data[:8]!r}); convert it: convert IN.jpg OUT.pgm")


def decode_pgm(data: bytes, where: object) -> Pixels:
    header = _PGM.match(data[:4096])
    if not header:
        raise ImageFileError(f"{where}: no PGM header: expected 'P5 width height 255', saw {data[:32]!r}")
    width, height, top = int(header[2]), int(header[3]), int(header[4])
    _check_size(where, width, height)
    if not 1 <= top <= 65535:
        raise ImageFileError(f"{where}: PGM maximum {top}: expected 1 to 65535")
    wide = top > 255
    pixels = _plain_pixels(data[header.end() :]) if header[1] == b"2" else _raw_pixels(data[header.end() :], wide)
    if len(pixels) < width * height:
        raise ImageFileError(f"{where}: cut short: {len(pixels)} of {width}x{height} pixels")
    pixels = np.minimum(pixels[: width * height].reshape(height, width), top)
    if top in (255, 65535):
        return np.asarray(pixels, np.uint16 if wide else np.uint8)
    return np.asarray(np.rint(pixels * (255.0 / top)), np.uint8)


def decode_png(data: bytes, where: object) -> Pixels:
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ImageFileError(f"{where}: a PNG without its header; is the file whole?")
    _check_size(where, int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))
    if b"IEND" not in data[-4096:]:
        raise ImageFileError(f"{where}: cut short: a PNG of {len(data)} bytes without its end")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageFileError(f"{where}: the PNG cannot be decoded; is the file whole?") from error
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise ImageFileError(f"{where}: the PNG cannot be decoded; is the file whole?")
    return np.asarray(pixels)


def encode_pgm(shades: NDArray[np.uint8]) -> bytes:
    """(H, W) uint8, first row on top, as a binary PGM."""
    height, width = shades.shape
    return b"P5\n%d %d\n255\n" % (width, height) + np.ascontiguousarray(shades).tobytes()


def encode_png(pixels: NDArray[np.uint8]) -> bytes:
    """(H, W) gray or (H, W, 3) BGR as PNG."""
    done, data = cv2.imencode(".png", pixels)
    assert done, "cv2 writes every uint8 image"
    return bytes(data)


def _check_size(where: object, width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise ImageFileError(f"{where}: {width}x{height} pixels; maps of 1 to {MAX_PIXELS} pixels can be read")


def _raw_pixels(data: bytes, wide: bool) -> Pixels:
    return np.frombuffer(data[: len(data) // 2 * 2], ">u2") if wide else np.frombuffer(data, np.uint8)


def _plain_pixels(data: bytes) -> Pixels:
    try:
        return np.array(re.sub(rb"#[^\r\n]*", b" ", data).split(), np.int64).clip(0, 65535)
    except (ValueError, OverflowError):
        return np.zeros(0, np.int64)
