"""Files that commands read and write, with what goes wrong turned into one sentence and an exit code."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path

from agent.exits import BAD_INPUT, ENVIRONMENT, USAGE, CommandError
from agent.files import write_atomically
from agent.map_files import MapFileError, MapSettings, load_map, read_settings, save_map
from protocol.grid import OccupancyGrid


def loaded_map(path: Path) -> OccupancyGrid:
    try:
        return load_map(path)
    except MapFileError as error:
        raise CommandError(str(error), BAD_INPUT) from error


def saved_map(grid: OccupancyGrid, stem: Path) -> list[Path]:
    """Writes stem.pgm and stem.yaml; returns both."""
    try:
        return list(save_map(grid, stem))
    except OSError as error:
        raise _cannot_write(stem, error) from error


def loaded_settings(path: Path) -> MapSettings:
    try:
        return read_settings(path)
    except MapFileError as error:
        raise CommandError(str(error), BAD_INPUT) from error


def spare_inputs(outputs: Iterable[Path], maps: Iterable[Path]) -> None:
    """Refuses to write over a map that is read: neither its YAML nor its image."""
    read = {file.resolve() for path in maps for file in (path, path.parent / loaded_settings(path).image)}
    for path in outputs:
        if path.resolve() in read:
            raise CommandError(f"{path}: this is one of the maps that are read; give another name with -o", USAGE)


def writable(path: Path) -> Path:
    """The same path, in a folder that is there and may be written: found out before the work, not after it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _cannot_write(path, error) from error
    if not os.access(path.parent, os.W_OK):
        raise _cannot_write(path, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))
    return path


def written_file(path: Path, data: bytes) -> Path:
    try:
        write_atomically(writable(path), data)
    except OSError as error:
        raise _cannot_write(path, error) from error
    return path


def _cannot_write(path: Path, error: OSError) -> CommandError:
    return CommandError(f"{path}: cannot be written ({error.strerror or error}); give another place", ENVIRONMENT)
