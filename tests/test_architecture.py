"""The walls between the rooms: who may import whom, which packages come in by one door, and what the pure rooms never touch.

The table is ARCHITECTURE.md's; every module is read as a syntax tree, and nothing is imported.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
OURS = ("protocol", "hw", "agent")

MAY_IMPORT = {  # room: what else of ours it may import (itself always)
    "protocol": (),
    "hw": ("protocol.geometry", "protocol.grid"),  # a pose, and the grid as a simulated world
    "agent.mapping": ("protocol", "hw.readings"),
    "agent.features": ("protocol",),
    "agent.merging": ("protocol", "agent.features"),
    "agent.fleet": ("protocol", "agent.merging"),
    "agent.view": ("protocol", "agent.__version__"),
    "agent.runtime": (
        "protocol", "hw", "agent.mapping", "agent.features", "agent.merging", "agent.fleet",
        "agent.config", "agent.config_sources", "agent.files", "agent.map_files",
        "agent.ros_frames", "agent.ros_messages", "agent.ros_names",
    ),
    "agent": ("protocol", "hw", "agent"),  # the command line and its commands
}  # fmt: skip
PURE = ("protocol", "agent.mapping", "agent.features", "agent.merging", "agent.fleet")
DOORS = {  # package: the modules that may import it
    "zenoh": ("agent.runtime.exchange", "agent.runtime.announcer"),
    "serial": ("hw.port",),
    "msgpack": ("protocol.codec",),
    "rosbags": ("agent.rosbags_reader",),
    "numpy": OURS,
    "cv2": OURS,
}
IMPURE_MODULES = {
    "time", "datetime", "sched", "threading", "_thread", "multiprocessing", "concurrent", "asyncio", "queue", "signal", "logging",
    "warnings", "socket", "ssl", "select", "selectors", "subprocess", "urllib", "http", "os", "io", "sys", "pathlib", "shutil",
    "tempfile", "glob", "fileinput", "mmap", "fcntl", "sqlite3", "secrets", "uuid",
}  # fmt: skip
IMPURE_CALLS = frozenset({"open", "print", "input", "breakpoint", "exec", "eval", "__import__"})
SEEDED = frozenset({"Generator", "default_rng", "SeedSequence", "PCG64", "PCG64DXSM", "Philox", "BitGenerator", "Random"})


@cache
def modules() -> dict[str, ast.Module]:
    """Module name -> its tree, for everything that ships."""
    found = {}
    for package in OURS:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            found[name] = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return found


def within(name: str, rooms: tuple[str, ...]) -> bool:
    return any(name == room or name.startswith(room + ".") for room in rooms)


def room_of(module: str) -> str:
    """The most particular room that the module stands in."""
    return max((room for room in MAY_IMPORT if within(module, (room,))), key=len)


def imports(module: str) -> Iterator[tuple[str, int]]:
    """(what, line) for every import, also those inside of functions; `from a import b` counts as a.b when that is a module."""
    for node in ast.walk(modules()[module]):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            for alias in node.names:
                yield (f"{base}.{alias.name}" if f"{base}.{alias.name}" in modules() or base == "agent" else base), node.lineno


def violations(rule: str, found: list[str]) -> None:
    assert not found, f"{rule}:\n" + "\n".join(found)


def test_rooms_import_only_what_lies_before_them() -> None:
    found = []
    for module in modules():
        room = room_of(module)
        allowed = (*MAY_IMPORT[room], room)
        for name, line in imports(module):
            if within(name, OURS) and not within(name, allowed):
                found.append(f"{module}:{line} imports {name}; {room} may import {', '.join(allowed)}")
    violations("values flow one way", found)


def test_nothing_below_imports_the_mind_and_nobody_imports_the_tests() -> None:
    found = [
        f"{module}:{line} imports {name}"
        for module in modules()
        for name, line in imports(module)
        if within(name, ("tests",)) or (within(name, ("agent",)) and within(module, ("protocol", "hw")))
    ]
    violations("nothing imports agent, nobody imports tests", found)


def test_outside_packages_come_in_by_their_doors() -> None:
    found = []
    for module in modules():
        for name, line in imports(module):
            package = name.partition(".")[0]
            if package in sys.stdlib_module_names or package in OURS:
                continue
            if package not in DOORS:
                found.append(f"{module}:{line} imports {package}: a guest without an invitation")
            elif not within(module, DOORS[package]):
                found.append(f"{module}:{line} imports {package}; its door is {', '.join(DOORS[package])}")
    violations("one door per package", found)


def test_imports_are_absolute() -> None:
    found = [
        f"{module}:{node.lineno}"
        for module, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    violations("the import is the path", found)


def test_pure_rooms_have_no_clock_thread_log_socket_file_or_luck() -> None:
    found = []
    for module in (name for name in modules() if within(name, PURE)):
        for name, line in imports(module):
            if name.partition(".")[0] in IMPURE_MODULES:
                found.append(f"{module}:{line} imports {name}")
        for node in ast.walk(modules()[module]):
            found += [f"{module}:{getattr(node, 'lineno', 0)} {sin}" for sin in impurities(node)]
    violations("values in, values out", found)


def impurities(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in IMPURE_CALLS:
        yield f"calls {node.func.id}()"
    if isinstance(node, ast.Attribute):
        owner = ast.unparse(node.value)
        if owner in ("np.random", "numpy.random", "random") and node.attr not in SEEDED:
            yield f"uses {owner}.{node.attr}: luck comes in as a generator"
        if owner in ("np", "numpy", "cv2") and re.fullmatch(
            r"load|save\w*|fromfile|memmap|imread|imwrite|VideoCapture|loadtxt", node.attr
        ):
            yield f"uses {owner}.{node.attr}: files are the runtime's"
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("default_rng", "random.Random")) and not node.args:
        yield "makes a generator without a seed"


@pytest.mark.parametrize("text", ["open('x')", "np.random.rand(3)", "np.random.default_rng()", "random.random()", "np.load('x')"])
def test_the_purity_check_sees(text: str) -> None:
    assert [sin for node in ast.walk(ast.parse(text)) for sin in impurities(node)]


def test_no_module_is_named_like_one_of_the_standard_library() -> None:
    top = [path.stem for path in ROOT.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()]
    violations("a shadow on the standard library", [name for name in top if name in sys.stdlib_module_names])


def test_every_room_is_known_and_every_module_says_what_it_is() -> None:
    found = [name for name, tree in modules().items() if tree.body and not ast.get_docstring(tree)]
    violations("a file opens by saying what the thing is", found)
    rooms = {".".join(path.relative_to(ROOT).parts) for path in (ROOT / "agent").iterdir() if (path / "__init__.py").exists()}
    assert rooms - {"agent.commands"} <= set(MAY_IMPORT)


def test_every_file_that_the_plan_of_the_house_names_is_there() -> None:
    named = re.findall(
        r"`((?:agent|hw|protocol|tests)/[\w/]+\.(?:py|md))`", (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    )
    assert len(named) > 15
    violations("ARCHITECTURE.md names it", [name for name in named if not (ROOT / name).is_file()])
