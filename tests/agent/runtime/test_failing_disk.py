"""A disk that fails at any call: the robot maps on, says so, and misses nothing once the disk is well.

Some calls stand here for all of them: `tests/campaigns/io_failures.py` takes every one.
"""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from agent.runtime.state import StateDirectory
from tests.harness.disk_work import SECONDS, live
from tests.harness.failing_disk import FailingDisk


@pytest.mark.parametrize(
    ("number", "error", "for_ever"),
    [
        (2, errno.EMFILE, False),
        (3, errno.EIO, True),
        (11, errno.ENOSPC, False),
        (12, errno.EROFS, False),
        (60, errno.ENOSPC, True),
    ],
)
def test_any_call_may_fail(tmp_path: Path, number: int, error: int, for_ever: bool) -> None:
    with FailingDisk(tmp_path) as disk:
        before = live(tmp_path / "r1", disk)
        disk.fail(number, error, for_ever=for_ever)
        life = live(tmp_path / "r1", disk, SECONDS - 10, before)
    assert disk.failures
    assert life.wrong == []


def test_a_map_that_cannot_be_read_just_now_is_not_set_aside(tmp_path: Path) -> None:
    state = StateDirectory(tmp_path)
    state.save("map", b"sound")
    with FailingDisk(tmp_path) as disk:
        disk.fail(2, errno.EIO, for_ever=True)
        assert state.load("map") is None
    assert "cannot read" in state.last_error
    assert state.load("map") == b"sound"
