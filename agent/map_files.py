"""nav2 map_server files: a small YAML beside a PGM or PNG image, read and written the way nav2 does.

    image: office.pgm           relative to the YAML
    mode: trinary               or scale, raw
    resolution: 0.05            metres a cell
    origin: [-10.0, -5.0, 0.0]  x, y, yaw of the lower-left corner; the image's first row is the top
    negate: 0
    occupied_thresh: 0.65
    free_thresh: 0.196          not the widespread 0.25: unknown is drawn as 205, which is 0.19608 and would read as free

`load_map("office.yaml")` gives an `OccupancyGrid`, `save_map(grid, "out/office")` writes the pair.  A file of another's making is
guilty until proven: its size is read from the header before anything is decoded.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath

import cv2
import numpy as np
from numpy.typing import NDArray

from agent.files import write_atomically
from agent.flat_yaml import FlatYamlError, decoded, parse_flat_yaml
from agent.image_files import ImageFileError, Pixels, encode_pgm, load_image
from protocol.geometry import SE2
from protocol.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

MODES = ("trinary", "scale", "raw")
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
OCCUPIED_SHADE, UNKNOWN_SHADE, FREE_SHADE = 0, 205, 254
SAVED_SHADES = (OCCUPIED_SHADE, UNKNOWN_SHADE, FREE_SHADE)
DRAWN_OVER = 0.05  # of the pixels of a map that somebody has edited
MAX_YAML_BYTES = 64 * 1024
RESOLUTIONS_M = (0.001, 10.0)
SURE_OCCUPIED, SURE_FREE = 70, 30  # percent; the paper's thresholds, for the in-between values of `scale` and `raw`


class MapFileError(Exception):
    """A map file that cannot be read: says which, what was seen, and what to try."""


@dataclass(frozen=True, slots=True)
class MapSettings:
    """What the YAML says."""

    image: str
    resolution_m: float
    origin: SE2
    mode: str = "trinary"
    negate: bool = False
    occupied_thresh: float = OCCUPIED_THRESH
    free_thresh: float = FREE_THRESH


def load_map(path: str | Path) -> OccupancyGrid:
    """The grid that nav2's map_server would serve, trinary; unknown stays unknown in files of nav2's map_saver too."""
    yaml_path = Path(path)
    settings = read_settings(yaml_path)
    try:
        pixels = load_image(yaml_path.parent / os.path.expanduser(settings.image))
    except ImageFileError as error:
        raise MapFileError(f"{yaml_path}: {error}{_beside(yaml_path, settings.image)}") from error
    cells = cells_of(pixels, as_saved(pixels, settings))
    return OccupancyGrid(np.ascontiguousarray(cells[::-1]), settings.resolution_m, settings.origin)


def _beside(yaml_path: Path, image: str) -> str:
    """A hint for a map that was copied from elsewhere: the image is there, but not where the YAML says."""
    name = PureWindowsPath(image).name  # takes / and \\ for the end of a folder
    is_there = name != image and "\0" not in name and (yaml_path.parent / name).is_file()
    return f"; {name} lies beside it: write image: {name}" if is_there else ""


def save_map(grid: OccupancyGrid, stem: str | Path) -> tuple[Path, Path]:
    """Writes stem.pgm and stem.yaml (the image first, so that a YAML always has one); a suffix of `stem` is dropped."""
    base = Path(stem)
    if base.suffix in (".yaml", ".yml", ".pgm", ".png"):
        base = base.with_suffix("")
    image_path, yaml_path = base.with_name(base.name + ".pgm"), base.with_name(base.name + ".yaml")
    base.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(image_path, encode_pgm(shades_of(grid)))
    write_atomically(yaml_path, yaml_text(grid, image_path.name).encode())
    return yaml_path, image_path


def shades_of(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """(H, W) uint8, first row on top: 0 occupied, 205 unknown, 254 free."""
    table = np.full(256, UNKNOWN_SHADE, np.uint8)
    table[OCCUPIED], table[FREE] = OCCUPIED_SHADE, FREE_SHADE
    return table[grid.cells[::-1].view(np.uint8)]


def yaml_text(grid: OccupancyGrid, image: str) -> str:
    origin = ", ".join(_plain(value) for value in (grid.origin.x_m, grid.origin.y_m, grid.origin.theta_rad))
    return (
        f"image: {image}\nmode: trinary\nresolution: {_plain(grid.resolution_m)}\norigin: [{origin}]\n"
        f"negate: 0\noccupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n"
    )


def read_settings(path: Path) -> MapSettings:
    """The YAML, checked; nothing of the image is touched."""
    try:
        if not (path.is_file() or path.is_dir()) and path.exists():
            raise MapFileError(f"{path}: no file but a device or a pipe; save the YAML to a file first")
        with path.open("rb") as stream:
            data = stream.read(MAX_YAML_BYTES + 1)
        if len(data) > MAX_YAML_BYTES or data[:2] in (b"P5", b"P2", b"\x89P"):
            raise MapFileError(f"{path}: this is no map YAML; give the .yaml file that names the image")
        return _settings(path, parse_flat_yaml(decoded(data)))
    except OSError as error:
        raise MapFileError(f"{path}: {error.strerror or error}") from error
    except FlatYamlError as error:
        raise MapFileError(f"{path}: no map YAML: {error}") from error


def as_saved(pixels: Pixels, settings: MapSettings) -> MapSettings:
    """The thresholds that the writer meant.

    nav2's map_saver draws unknown as 205 and wrote free_thresh 0.25 beside it until 2025 (navigation2 pull request 5278): by that
    all it did not know is free.  Its three shades give it away, also where somebody has drawn a little with others.
    """
    if settings.mode != "trinary" or settings.negate or settings.free_thresh <= FREE_THRESH or pixels.dtype != np.uint8:
        return settings
    counts = np.bincount((pixels if pixels.ndim == 2 else pixels[:, :, 0]).ravel(), minlength=256)
    is_its_own = counts[list(SAVED_SHADES)].sum() >= (1 - DRAWN_OVER) * counts.sum()
    return replace(settings, free_thresh=FREE_THRESH) if is_its_own else settings


def cells_of(pixels: Pixels, settings: MapSettings) -> NDArray[np.int8]:
    """(H, W) int8 of UNKNOWN, FREE, OCCUPIED from (H, W) or (H, W, C) pixels, as map_io.cpp decides.

    But for opacity in trinary mode: there map_io.cpp counts it as a fourth colour, which makes opaque unknown free.  Here, as
    in scale mode, what is not opaque is unknown, and what is opaque reads as if nothing were said of it.
    """
    depth = float(np.iinfo(pixels.dtype).max)
    gray, alpha = _split(pixels)
    shades = np.arange(depth + 1) / depth  # every shade there can be, looked up once instead of computed per pixel
    if settings.mode == "raw":
        percent = np.rint(shades * 255)
        table = np.where(percent > 100, UNKNOWN, _sure(percent))
    else:
        occupancy = shades if settings.negate else 1.0 - shades
        low, high = settings.free_thresh, settings.occupied_thresh
        between = (
            _sure(np.rint((occupancy - low) / (high - low) * 100)) if settings.mode == "scale" else np.full(len(shades), UNKNOWN)
        )
        table = np.where(occupancy > high, OCCUPIED, np.where(occupancy < low, FREE, between))
    cells: NDArray[np.int8] = table.astype(np.int8)[gray]
    if alpha is not None and settings.mode != "raw":
        cells[alpha != depth] = UNKNOWN
    return cells


def _split(pixels: Pixels) -> tuple[Pixels, Pixels | None]:
    """One shade a pixel, and the opacity when there is one."""
    if pixels.ndim == 2:
        return pixels, None
    has_alpha = pixels.shape[2] in (2, 4)
    colours = pixels[:, :, : pixels.shape[2] - has_alpha]
    weights = np.full((1, colours.shape[2]), 1.0 / colours.shape[2], np.float32)
    gray = cv2.transform(np.ascontiguousarray(colours), weights)
    return gray.reshape(pixels.shape[:2]), pixels[:, :, -1] if has_alpha else None


def _sure(percent: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.where(percent >= SURE_OCCUPIED, OCCUPIED, np.where(percent <= SURE_FREE, FREE, UNKNOWN))


def _settings(path: Path, values: dict[str, str | list[str]]) -> MapSettings:
    for key in ("image", "resolution", "origin"):
        if key not in values:
            other = next((f"saw '{other}': keys are in lower case" for other in values if other.lower() == key), "")
            raise MapFileError(f"{path}: '{key}' is missing; {other or 'a nav2 map YAML has image, resolution and origin'}")
    image, mode = values["image"], values.get("mode", "trinary")
    mode = mode.lower() if isinstance(mode, str) else mode
    if not isinstance(image, str) or not image:
        raise MapFileError(f"{path}: image: expected a file name, saw {image!r}")
    if mode not in MODES:
        raise MapFileError(f"{path}: mode: expected one of {', '.join(MODES)}, saw {mode!r}")
    resolution_m = _number(path, "resolution", values["resolution"], *RESOLUTIONS_M)
    occupied = _number(path, "occupied_thresh", values.get("occupied_thresh", str(OCCUPIED_THRESH)), 0.0, 1.0)
    free = _number(path, "free_thresh", values.get("free_thresh", str(FREE_THRESH)), 0.0, 1.0)
    if free >= occupied:
        raise MapFileError(f"{path}: free_thresh {free} must be below occupied_thresh {occupied}")
    negate = _truth(path, values.get("negate", "0"))
    return MapSettings(image, resolution_m, _origin(path, values["origin"]), str(mode), negate, occupied, free)


def _origin(path: Path, value: str | list[str]) -> SE2:
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise MapFileError(f"{path}: origin: expected [x, y, yaw], saw {value!r}")
    x_m, y_m = (_number(path, "origin", text, -1e7, 1e7) for text in value[:2])
    yaw_rad = _number(path, "origin: yaw in radians", [*value, "0"][2], -math.tau, math.tau)
    return SE2(x_m, y_m, yaw_rad)


def _number(path: Path, key: str, value: str | list[str], low: float, high: float) -> float:
    try:
        number = float(value) if isinstance(value, str) else math.nan
    except ValueError:
        number = math.nan
    if not low <= number <= high:
        raise MapFileError(f"{path}: {key}: expected a number from {low:g} to {high:g}, saw {value!r}")
    return number


def _truth(path: Path, value: str | list[str]) -> bool:
    words = {"0": False, "false": False, "no": False, "1": True, "true": True, "yes": True}
    if not isinstance(value, str) or value.lower() not in words:
        raise MapFileError(f"{path}: negate: expected 0 or 1, saw {value!r}")
    return words[value.lower()]


def _plain(number: float) -> str:
    """Without an exponent, which YAML 1.1 readers take for text."""
    text = repr(float(number))
    return f"{number:.12f}" if "e" in text else text
