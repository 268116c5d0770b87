"""What the pages promise exists: every command line parses, every linked file is there, every Python line runs its imports."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
from pathlib import Path

import pytest

from agent.cli import COMMANDS, command_parser, top_parser

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    page for page in (ROOT / "README.md", ROOT / "deploy" / "README.md", ROOT / "tests" / "bench" / "README.md") if page.exists()
]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.S | re.M)


def blocks(page: Path, *languages: str) -> list[str]:
    return [text for language, text in BLOCK.findall(page.read_text()) if language in languages]


def command_lines(page: Path) -> list[list[str]]:
    """Every line of a shell block that starts mapquilt, as words behind the command's own name."""
    found = []
    for block in blocks(page, "sh", "bash", "console", "shell"):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r"&&|\||;|\s>\s", line.removeprefix("$ ")):
                words = shlex.split(part, comments=True)
                while words and (words[0] in ("sudo", "-", "time") or re.fullmatch(r"[A-Z_]+=\S*", words[0])):
                    words = words[1:]
                if words and words[0] in ("mapquilt", "./run", ".venv/bin/mapquilt"):
                    found.append(words[1:])
    return found


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_command_line_parses(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in command_lines(page):
        if not words or words[0] == "test":  # ./run test is the script's own
            continue
        is_top = words[0].startswith("-")
        assert is_top or words[0] in COMMANDS, f"{page.name}: {words}"
        parser = top_parser() if is_top else command_parser(words[0])
        try:
            parser.parse_args(words if is_top else words[1:])
        except SystemExit as end:
            assert end.code == 0, f"{page.name}: {shlex.join(words)}: {capsys.readouterr().err}"


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_linked_file_is_there(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
        if not re.match(r"[a-z]+:", target):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_what_python_examples_import_is_there(page: Path) -> None:
    for block in blocks(page, "python", "py"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(str(node.module))
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                assert missing == [], f"{page.name}: from {node.module} import {missing}"


def test_the_installers_and_checks_named_in_the_pages_exist() -> None:
    for page in PAGES:
        for script in re.findall(r"(?:\./|deploy/)[a-z_]+(?:\.sh)?(?=[\s`])", page.read_text()):
            assert (ROOT / script).exists(), f"{page.name} names {script}"
