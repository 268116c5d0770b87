"""TOML < environment < flags: settings read from where people write them, checked, each with its origin.

    robot.toml                        [matching]
                                      min_match_factor = 0.9
    environment                       MAPQUILT_MATCHING__MIN_MATCH_FACTOR=0.9
    flag                              --set matching.min_match_factor=0.9

An unknown name, a wrong type or a value out of range stops the start: with where, what was seen, and what was likely meant.
"""

from __future__ import annotations

import difflib
import math
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agent.config import Config, ConfigError, Key, Value, default_robot_id, keys, sections
from protocol.names import is_robot_id

PREFIX = "MAPQUILT_"
NOT_SETTINGS = {"MAPQUILT_CONFIG", "MAPQUILT_SHARED"}  # ours as well, but no settings of a robot
SYSTEM_CONFIG = Path("/etc/mapquilt/robot.toml")  # what deploy/install.sh writes
MAX_FILE_BYTES = 1 << 20
TRUE, FALSE = ("1", "true", "yes", "on"), ("0", "false", "no", "off")


@dataclass(frozen=True, slots=True)
class Loaded:
    """The settings in force, and where each came from ("default", "robot.toml", "$MAPQUILT_...", "--flag")."""

    config: Config
    origins: Mapping[str, str]
    file: Path | None


def load_config(
    file: str | Path | None = None, flags: Iterable[tuple[str, str, Any]] = (), environ: Mapping[str, str] | None = None
) -> Loaded:
    """Settings of a robot; `flags` are (origin, "section.key", value), the last of the same key winning."""
    environ = os.environ if environ is None else environ
    path = config_file(file, environ)
    written = list(_from_file(path)) if path else []
    written += _from_environment(environ)
    written += flags
    return _assembled(written, path)


def config_file(given: str | Path | None, environ: Mapping[str, str]) -> Path | None:
    """The file to read: the one asked for (which must exist), else the first that is there, else none."""
    asked = given or environ.get("MAPQUILT_CONFIG")
    if asked:
        return Path(asked)
    home = environ.get("XDG_CONFIG_HOME") or str(Path(environ.get("HOME") or "~").expanduser() / ".config")
    places = (Path(home) / "mapquilt" / "config.toml", SYSTEM_CONFIG)
    return next((place for place in places if place.is_file()), None)


def checked(where: str, name: str, value: Any) -> Value:
    """The value as its setting's type, or a ConfigError that starts with `where`."""
    key = keys().get(name)
    if key is None:
        raise ConfigError(f"{where}: unknown key '{name}'{_suggestion(name)}")
    result = _typed(where, key, value)
    _check_range(where, key, result)
    if name == "robot.id" and result and not is_robot_id(str(result)):
        raise ConfigError(f"{where}: robot.id = {value!r}: use 1 to 32 of a-z, 0-9, '-' and '_', first a letter or digit")
    return result


def assignment(where: str, text: str) -> tuple[str, str, str]:
    """`--set section.key=value` as a flag entry."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ConfigError(f"{where} {text}: expected section.key=value, as in --set matching.min_match_factor=0.9")
    return where, name.strip(), value.strip()


def _from_file(path: Path) -> Iterable[tuple[str, str, Any]]:
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise ConfigError(f"{path}: over {MAX_FILE_BYTES} bytes; is this really a settings file?")
        table = tomllib.loads(data.decode("utf-8-sig"))  # Windows editors write a mark first
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}; give another file with --config") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    for section, entries in table.items():
        if not isinstance(entries, dict):
            near = _suggestion(section)
            raise ConfigError(f"{path}: '{section}' stands outside of any section{near or '; sections are ' + _sections()}")
        if not entries and section not in sections():
            raise ConfigError(f"{path}: unknown section [{section}]; sections are {_sections()}")
        for key, value in entries.items():
            yield str(path), f"{section}.{key}", value


def _from_environment(environ: Mapping[str, str]) -> list[tuple[str, str, Any]]:
    found = []
    for variable in sorted(environ):
        if variable.startswith(PREFIX) and variable not in NOT_SETTINGS:
            name = variable[len(PREFIX) :].lower().replace("__", ".", 1)
            found.append((f"${variable}", name, environ[variable]))
    return found


def _assembled(written: Iterable[tuple[str, str, Any]], path: Path | None) -> Loaded:
    values: dict[str, Value] = {}
    origins = dict.fromkeys(keys(), "default")
    for where, name, value in written:
        values[name] = checked(where, name, value)
        origins[name] = where
    if not values.get("robot.id"):
        values["robot.id"], origins["robot.id"] = default_robot_id(), "host name"
    made = {}
    for section, kind in sections().items():
        prefix = section + "."
        made[section] = kind(**{name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)})
    return Loaded(Config(**made), origins, path)


def _typed(where: str, key: Key, value: Any) -> Value:
    """TOML gives typed values, the environment and flags give text; both end as the setting's own type."""
    wrong = ConfigError(f"{where}: {key.name} = {value!r}: expected {_expected(key)}")
    if key.kind is tuple:
        parts = [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value
        if not isinstance(parts, (list, tuple)) or not all(isinstance(part, str) for part in parts):
            raise wrong
        return tuple(parts)
    if key.kind is bool:
        word = str(value).lower()
        if not isinstance(value, (bool, str)) or word not in TRUE + FALSE:
            raise wrong
        return word in TRUE
    if key.kind is str:
        if not isinstance(value, str):
            raise wrong
        return value
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise wrong
    try:
        return int(value) if key.kind is int and not isinstance(value, float) else _finite(key.kind, value)
    except (ValueError, OverflowError) as error:
        raise wrong from error


def _finite(kind: type, value: float | str) -> float:
    number = float(value)
    if kind is int or not math.isfinite(number):
        raise ValueError("not a whole number, or not finite")
    return number


def _check_range(where: str, key: Key, value: Value) -> None:
    if key.choices and value not in key.choices:
        near = difflib.get_close_matches(str(value), key.choices, 1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise ConfigError(f"{where}: {key.name} = {value!r}: expected {_expected(key)}{hint}")
    if isinstance(value, (int, float)) and key.kind is not bool and not _is_within(key, value):
        raise ConfigError(f"{where}: {key.name} = {value!r}: expected {_expected(key)}")


def _is_within(key: Key, number: float) -> bool:
    return (key.low is None or number >= key.low) and (key.high is None or number <= key.high)


def _expected(key: Key) -> str:
    if key.choices:
        return "one of " + ", ".join(key.choices)
    words = {str: "text", int: "a whole number", float: "a number", bool: "true or false", tuple: "a list of texts"}[key.kind]
    return words if key.low is None else f"{words} from {key.low:g} to {key.high:g}"


def _suggestion(name: str) -> str:
    """ "; did you mean ...?" by the whole name, or by the key alone when it stands in the wrong section."""
    known = keys()
    section, _, last = name.rpartition(".")
    same_section = [key.partition(".")[2] for key in known if key.startswith(section + ".")]
    near = difflib.get_close_matches(last, same_section, 1, cutoff=0.5)
    if near:
        return f"; did you mean '{section}.{near[0]}'?"
    if len(same_section) == 1:
        return f"; [{section}] has '{section}.{same_section[0]}' only"
    elsewhere = [key for key in known if key.endswith("." + last)]
    near = elsewhere or difflib.get_close_matches(name, known, 1, cutoff=0.6)
    if near:
        return f"; did you mean '{near[0]}'?"
    return "" if not section else f"; sections are {_sections()}" if section not in sections() else ""


def _sections() -> str:
    return ", ".join(f"[{name}]" for name in sections())
