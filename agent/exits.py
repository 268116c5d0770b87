"""How a command ends: the codes that scripts read, and the one error that carries a code.

A command prints its data on stdout and raises `CommandError` for everything that a person must be told; `agent/cli.py` prints
the message on stderr and ends with the code.
"""

from __future__ import annotations

OK = 0
NEGATIVE = 1  # it ran, and the answer is no: the maps do not match, a check failed
USAGE = 2
ENVIRONMENT = 3
BAD_INPUT = 4
PEER = 5
BUG = 70
INTERRUPTED = 130

EXIT_CODES = """\
  0    done
  1    done, and the answer is no (merge: no match; doctor: something failed)
  2    the command line or a setting is wrong
  3    this machine lacks something (Python, packages, permissions)
  4    an input file cannot be read
  5    the robot, a peer or the network does not answer
  70   a bug of ours: please report it with the message
  130  stopped by Ctrl-C
  143  stopped by SIGTERM
"""


class CommandError(Exception):
    """What went wrong, where, and what to try next; ends the command with `code`."""

    def __init__(self, message: str, code: int = NEGATIVE) -> None:
        super().__init__(message)
        self.code = code
