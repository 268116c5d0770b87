"""`mapquilt completion bash|zsh|fish|man`: TAB completion as a static file, and a man page, made from the commands' parsers."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import dataclass

from agent import __version__
from agent.cli import COMMANDS, command_parser
from agent.cli import EXAMPLES as TOP_EXAMPLES
from agent.exits import EXIT_CODES, OK

EXAMPLES = """\
  mapquilt completion bash > ~/.local/share/bash-completion/completions/mapquilt
  mapquilt completion zsh > ~/.zfunc/_mapquilt        with fpath+=~/.zfunc before compinit in ~/.zshrc
  mapquilt completion fish > ~/.config/fish/completions/mapquilt.fish
  mapquilt completion man | man -l -
"""


@dataclass(frozen=True, slots=True)
class Option:
    """One flag as a shell needs it."""

    flags: tuple[str, ...]
    text: str
    takes_value: bool
    choices: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Command:
    """One command with its flags and the words it takes first."""

    name: str
    summary: str
    options: tuple[Option, ...]
    words: tuple[str, ...] = ()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=tuple(WRITERS), help="what to write, on stdout")


def run(args: argparse.Namespace) -> int:
    print(WRITERS[args.shell](commands()), end="")
    return OK


def commands() -> list[Command]:
    """Every command, as its parser describes it."""
    return [_command(name, summary, command_parser(name)) for name, (_, summary) in COMMANDS.items()]


def _command(name: str, summary: str, parser: argparse.ArgumentParser) -> Command:
    options: list[Option] = []
    words: tuple[str, ...] = ()
    for action in parser._actions:  # argparse offers no other way to look at a parser
        choices = tuple(map(str, action.choices or ()))
        if action.help == argparse.SUPPRESS:
            continue
        if action.option_strings:
            options.append(
                Option(tuple(action.option_strings), (action.help or "").replace("%%", "%"), action.nargs != 0, choices)
            )
        else:
            words = words or choices
    return Command(name, summary, tuple(options), words)


def bash(found: list[Command]) -> str:
    cases = "".join(
        f"        {c.name}) words='{' '.join([*c.words, *(flag for o in c.options for flag in o.flags)])}' ;;\n" for c in found
    )
    values = "".join(
        f"        {c.name}:{flag}) COMPREPLY=($(compgen -W '{' '.join(o.choices)}' -- \"$now\")); return ;;\n"
        for c in found
        for o in c.options
        if o.choices
        for flag in o.flags
    )
    names = " ".join(c.name for c in found)
    return f"""# bash completion of mapquilt {__version__}; made by: mapquilt completion bash
_mapquilt() {{
    local now=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} command=${{COMP_WORDS[1]}} words=''
    if [ "$COMP_CWORD" -eq 1 ]; then
        COMPREPLY=($(compgen -W '{names} --help --version' -- "$now"))
        return
    fi
    case $command:$before in
{values}    esac
    case $command in
{cases}    esac
    COMPREPLY=($(compgen -W "$words" -- "$now") $(compgen -f -- "$now"))
}}
complete -o filenames -F _mapquilt mapquilt
"""


def zsh(found: list[Command]) -> str:
    described = "\n".join(f"        {_quoted(f'{c.name}:{c.summary}')}" for c in found)
    cases = "".join(f"        {c.name}) _arguments {' '.join(_zsh_specs(c))} ;;\n" for c in found)
    return f"""#compdef mapquilt
# zsh completion of mapquilt {__version__}; made by: mapquilt completion zsh
_mapquilt() {{
    local -a commands
    commands=(
{described}
    )
    if (( CURRENT == 2 )); then
        _describe command commands
        return
    fi
    local command=$words[2]
    shift words
    (( CURRENT-- ))
    case $command in
{cases}    esac
}}
_mapquilt "$@"
"""


def _zsh_specs(command: Command) -> list[str]:
    specs = []
    for option in command.options:
        text = re.sub(r"[\[\]:\\]", " ", option.text)
        value = f":value:({' '.join(option.choices)})" if option.choices else ":value:_files" if option.takes_value else ""
        specs += [_quoted(f"{flag}[{text}]{value}") for flag in option.flags]
    rest = f"*:word:({' '.join(command.words)})" if command.words else "*:file:_files"
    return [*specs, _quoted(rest)]


def fish(found: list[Command]) -> str:
    lines = [f"# fish completion of mapquilt {__version__}; made by: mapquilt completion fish"]
    for command in found:
        lines.append(f"complete -c mapquilt -f -n __fish_use_subcommand -a {command.name} -d {_quoted(command.summary)}")
        here = f"complete -c mapquilt -n '__fish_seen_subcommand_from {command.name}'"
        if command.words:
            lines.append(f"{here} -f -a '{' '.join(command.words)}'")
        for option in command.options:
            flags = " ".join(f"-l {flag[2:]}" if flag.startswith("--") else f"-s {flag[1:]}" for flag in option.flags)
            value = f" -x -a '{' '.join(option.choices)}'" if option.choices else " -r" if option.takes_value else ""
            lines.append(f"{here} {flags}{value} -d {_quoted(option.text, fish=True)}")
    return "\n".join(lines) + "\n"


def man(found: list[Command]) -> str:
    """mapquilt(1), in man(7) macros."""
    parts = [
        f'.TH MAPQUILT 1 "" "mapquilt {__version__}"',
        ".SH NAME",
        "mapquilt \\- robots that explore apart end up with one map",
        ".SH SYNOPSIS",
        ".B mapquilt\n.I command\n[options]",
        ".SH DESCRIPTION",
        "Robots that explore apart find out by themselves how their maps fit together, and end up with one map.",
        ".SH EXAMPLES\n.nf",
        _roff(TOP_EXAMPLES.rstrip()),
        ".fi\n.SH COMMANDS",
    ]
    for command in found:
        parts.append(f".SS {command.name}\n{_roff(command.summary[0].upper() + command.summary[1:])}.")
        for option in command.options:
            value = f" {{{','.join(option.choices)}}}" if option.choices else " VALUE" if option.takes_value else ""
            parts.append(f".TP\n.B {_roff(', '.join(option.flags) + value)}\n{_roff(option.text)}")
    parts += [".SH ENVIRONMENT", ".TP\n.B MAPQUILT_CONFIG\nthe settings file", ".TP\n.B MAPQUILT_SECTION__KEY\none setting"]
    parts += [".TP\n.B NO_COLOR\nplain text", ".SH EXIT STATUS\n.nf", _roff(EXIT_CODES.rstrip()), ".fi"]
    return "\n".join(parts) + "\n"


def _roff(text: str) -> str:
    """No line of somebody's text may be taken for a macro."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-")
    return re.sub(r"(?m)^([.'])", r"\\&\1", escaped)


def _quoted(text: str, *, fish: bool = False) -> str:
    """As one word for a shell; fish escapes a quote within quotes, the others close and reopen."""
    if fish:
        return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
    return "'" + text.replace("'", "'\\''") + "'"


WRITERS: dict[str, Callable[[list[Command]], str]] = {"bash": bash, "zsh": zsh, "fish": fish, "man": man}
