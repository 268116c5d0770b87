"""C15: from a fresh clone to a merged map, and an installation that survives being killed at any moment.

    .venv/bin/python -m tests.campaigns.bootstrap [--kills 10] [--seed 1] [--json]

Needs the package index (or whatever pip is set to use) and git; everything happens in a temporary directory.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.campaigns.claims import Claim, judged

ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=10, help="installations killed at a random moment")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mapquilt bootstrap ") as folder:
        claims = list(campaign(Path(folder), args.kills, random.Random(args.seed)))
    return judged(claims, as_json=args.json)


def campaign(folder: Path, kills: int, rng: random.Random) -> Iterator[Claim]:
    clone = folder / "clone"
    subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
    first_s = timed(lambda: run(clone, "--version"))
    yield Claim("first start installs", "<= 60 s", f"{first_s:.1f} s", first_s <= 60)
    offline = {"PIP_NO_INDEX": "1", "UV_OFFLINE": "1", "https_proxy": "http://127.0.0.1:9"}
    second_s = min(timed(lambda: run(clone, "--version", **offline)) for _ in range(5))
    yield Claim("second start, no network", "< 1 s", f"{second_s:.3f} s", second_s < 1)
    yield killed(clone, kills, rng, first_s)
    yield tampered(clone)
    yield demo(clone, folder / "demo")


def killed(clone: Path, kills: int, rng: random.Random, install_s: float) -> Claim:
    """kill -9 of the whole installation at a random moment; then one start must be enough."""
    whole = 0
    for _ in range(kills):
        subprocess.run(["rm", "-rf", str(clone / ".venv")], check=True)
        child = subprocess.Popen(
            [clone / "run", "--version"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        time.sleep(rng.uniform(0.0, install_s))
        with contextlib.suppress(ProcessLookupError):  # it was done already
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
        done = run(clone, "config", "check", check=False)
        whole += done.returncode == 0 and imports_work(clone)
    return Claim(
        "an installation killed at a random moment is whole after the next start", "all", f"{whole} of {kills}", whole == kills
    )


def tampered(clone: Path) -> Claim:
    """One hash digit changed in the lock: nothing is installed."""
    lock = clone / "requirements.lock"
    text = lock.read_text()
    at = text.index("msgpack==")
    start = text.index("sha256:", at)
    end = text.index("numpy==", at)
    broken = text[start:end].replace("sha256:", "sha256:0000", 10**6)
    lock.write_text(text[:start] + "".join(cut(line) for line in broken.splitlines(keepends=True)) + text[end:])
    subprocess.run(["rm", "-rf", str(clone / ".venv")], check=True)
    done = run(clone, "--version", check=False)
    lock.write_text(text)
    run(clone, "--version")
    return Claim("a package that does not match its hash is refused", "exit 3", f"exit {done.returncode}", done.returncode == 3)


def cut(line: str) -> str:
    """A hash of the right length again, and a wrong one."""
    head, found, digits = line.partition("sha256:")
    return line if not found else f"{head}{found}{digits[:64]}{digits[68:]}"


def demo(clone: Path, out: Path) -> Claim:
    started = time.monotonic()
    done = run(clone, "demo", "--no-serve", "--json", "--out", str(out), check=False)
    seconds = time.monotonic() - started
    merged = (out / "merged.png").exists()
    return Claim(
        "./run demo ends with merged.png",
        "<= 60 s",
        f"{seconds:.1f} s, exit {done.returncode}",
        merged and seconds <= 60 and not done.returncode,
    )


def run(clone: Path, *words: str, check: bool = True, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [clone / "run", *words], env={**os.environ, **environ}, capture_output=True, text=True, check=check, timeout=600
    )


def imports_work(clone: Path) -> bool:
    probe = "import zenoh, numpy, cv2, msgpack, serial, agent, protocol, hw"
    return (
        subprocess.run([clone / ".venv/bin/python", "-P", "-c", probe], cwd="/", capture_output=True, check=False).returncode == 0
    )


def timed(action: Callable[[], object]) -> float:
    started = time.monotonic()
    action()
    return time.monotonic() - started


if __name__ == "__main__":
    raise SystemExit(main())
