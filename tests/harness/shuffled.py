"""A pytest plugin: tests in another order, by the seed in MAPQUILT_SHUFFLE; every worker of xdist comes to the same order.

pytest -p tests.harness.shuffled
"""

from __future__ import annotations

import os
import random

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files in random order, and within a file its tests: what a file sets up once is set up once."""
    rng = random.Random(os.environ.get("MAPQUILT_SHUFFLE", "0"))
    files = {item.path: rng.random() for item in items}
    items.sort(key=lambda item: (files[item.path], rng.random()))
