"""What a robot, or a fleet, may be called."""

from __future__ import annotations

import re

ROBOT_ID = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
"""One chunk of a key expression, one CN of a certificate, one file name, one label on a screen: no space, no `*`, no slash."""


def is_robot_id(text: str) -> bool:
    return ROBOT_ID.fullmatch(text) is not None
