"""What a bad cable makes of bytes, hours of them in numpy: some are lost, some arrive as others."""

from __future__ import annotations

import argparse
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

BURST_BYTES = 20.0  # the usual length of a burst, geometrically distributed: a millisecond at 230400 baud
KINDS = ("bytes", "bursts")


def options(doc: str, victims: str, names: Iterable[str]) -> argparse.ArgumentParser:
    """What a campaign on bad lines is told; `victims` are what stands at their ends, each of the `names` unless `only` some."""
    parser = argparse.ArgumentParser(description=doc.split("\n", maxsplit=1)[0])
    parser.add_argument("--hours", type=float, default=1.0, help=f"of robot time for each of the {victims}")
    parser.add_argument("--share", type=float, default=0.01, help="of bytes damaged: half lost, half altered")
    parser.add_argument("--kind", choices=KINDS, default="bytes", help="one by one, or in bursts")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=list(names), default=list(names), help=victims)
    parser.add_argument("--json", action="store_true")
    return parser


def how(share: float, kind: str) -> str:
    """What the line did, in words."""
    return f"{share:.3%} of the bytes lost or altered, {'one by one' if kind == 'bytes' else 'in bursts'}"


def damaged(clean: NDArray[np.uint8], kind: str, share: float, rng: np.random.Generator) -> tuple[bytes, int]:
    """A copy with a share of its bytes damaged, half of the hits losses, half changes, and how many bytes were hit.

    One by one, half of the changes turn a single bit; a burst makes any bytes of its own.
    """
    at, is_lost = _single(len(clean), share, rng) if kind == "bytes" else _bursts(len(clean), share, rng)
    one_bit = 1 << rng.integers(0, 8, len(at))
    any_bits = rng.integers(1, 256, len(at))
    flips = any_bits if kind == "bursts" else np.where(rng.random(len(at)) < 0.5, one_bit, any_bits)
    data = clean.copy()
    data[at] ^= np.where(is_lost, 0, flips).astype(np.uint8)
    is_kept = np.ones(len(clean), bool)
    is_kept[at[is_lost]] = False
    return data[is_kept].tobytes(), len(at)


def _single(n: int, share: float, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    at = np.unique(rng.integers(0, n, rng.poisson(n * -np.log1p(-share))))  # as many draws as hit that share of all
    return at, rng.random(len(at)) < 0.5


def _bursts(n: int, share: float, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    n_bursts = int(rng.poisson(n * share / BURST_BYTES))
    first, lengths = rng.integers(0, n, n_bursts), rng.geometric(1.0 / BURST_BYTES, n_bursts)
    offsets = np.arange(int(lengths.sum())) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    at, which = np.unique(np.repeat(first, lengths) + offsets, return_index=True)
    is_lost = np.repeat(rng.random(n_bursts) < 0.5, lengths)[which]
    return at[at < n], is_lost[at < n]
