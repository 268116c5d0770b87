"""C15 and C14 in a bare Debian with nothing but Python: installed without a network, started, tried, taken off again.

    .venv/bin/python -m tests.campaigns.bare_debian [--release bookworm] [--base DIR] [--wheels DIR] [--no-test] [--json]

Needs root, debootstrap, iproute2 and, for the base and the wheels, a network.  What is installed runs in a chroot in namespaces
of its own: no network but loopback, its own /proc and /tmp.  `--base` and `--wheels` keep what was fetched for the next time.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.campaigns.bootstrap import ROOT
from tests.campaigns.claims import Claim, judged

PACKAGES = "python3,python3-venv,systemd"
OFFLINE = {
    "PIP_NO_INDEX": "1",
    "PIP_FIND_LINKS": "/wheels",
    "HOME": "/root",
    "PATH": "/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin",
}
BEGIN = """
set -e
mount -t proc proc "$0/proc"
mount -t tmpfs -o mode=1777 tmpfs "$0/tmp"
mount --rbind /dev "$0/dev"
ip link set lo up
root=$0
exec chroot "$root" /bin/sh -c "$1"
"""
STATE = (
    "/opt/mapquilt /usr/local/bin/mapquilt /etc/systemd/system/mapquilt@.service"
    " /etc/udev/rules.d/90-mapquilt.rules /etc/mapquilt"
)
KEYS = "cd /root && mapquilt fleet init keys --fleet mapquilt && mapquilt fleet enroll keys robot-1"
UNDER_MDWE = (
    "import ctypes, os; assert ctypes.CDLL(None).prctl(65, 1, 0, 0, 0) == 0; os.execv('/usr/local/bin/mapquilt', 'mapquilt run"
    " --config /etc/mapquilt/robot.toml --id robot-1 --lidar sim:office?seed=3 --ready-json'.split())"
)


class Bare:
    """A bare Debian with this checkout and the wheels in it."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def run(self, command: str, timeout_s: float = 900.0) -> tuple[float, subprocess.CompletedProcess[str]]:
        """A shell command inside, without a network; how long it took."""
        started = time.monotonic()
        words = ["unshare", "--mount", "--net", "--pid", "--fork", "--kill-child", "sh", "-c", BEGIN, str(self.root), command]
        done = subprocess.run(words, env=OFFLINE, capture_output=True, text=True, timeout=timeout_s, check=False)
        if done.returncode:
            print(f"{command}: {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}", file=sys.stderr)
        return time.monotonic() - started, done


def main(argv: list[str] | None = None) -> int:
    parser = options(__doc__)
    parser.add_argument("--no-test", action="store_true", help="without ./run test, which takes minutes")
    args = parser.parse_args(argv)
    with bare_debian(args) as root:
        claims = list(campaign(Bare(root), is_tested=not args.no_test))
    return judged(claims, as_json=args.json)


def options(doc: str | None) -> argparse.ArgumentParser:
    """What every campaign in a bare Debian is told."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--release", default="bookworm")
    parser.add_argument("--base", type=Path, help="the bare system; made when it is not there")
    parser.add_argument("--wheels", type=Path, help="the packages; fetched when they are not there")
    parser.add_argument("--json", action="store_true")
    return parser


@contextlib.contextmanager
def bare_debian(args: argparse.Namespace) -> Iterator[Path]:
    """The root folder of a bare Debian with this checkout and the packages in it, gone afterwards."""
    if os.geteuid() != 0 or not shutil.which("debootstrap"):
        print("this needs root and debootstrap: sudo apt-get install debootstrap iproute2", file=sys.stderr)
        raise SystemExit(3)
    with tempfile.TemporaryDirectory(prefix="bare-") as folder:
        base, wheels = args.base or Path(folder) / "base", args.wheels or Path(folder) / "wheels"
        prepare(base, wheels, args.release)
        yield copied(base, wheels, Path(folder) / "root")


def prepare(base: Path, wheels: Path, release: str) -> None:
    """The bare system, and the packages of both locks."""
    if not (base / "usr/bin/python3").exists():
        subprocess.run(
            ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", release, base], check=True, stdout=sys.stderr
        )
    if not wheels.is_dir():
        subprocess.run([ROOT / "deploy/wheelhouse.sh", wheels], check=True, stdout=sys.stderr)
        fetch = [sys.executable, "-m", "pip", "download", "--quiet", "--require-hashes", "--no-deps", "--only-binary", ":all:"]
        subprocess.run([*fetch, "--dest", wheels, "-r", ROOT / "requirements-dev.lock"], check=True, stdout=sys.stderr)


def copied(base: Path, wheels: Path, root: Path) -> Path:
    subprocess.run(["cp", "-a", base, root], check=True)
    (root / "etc/hosts").write_text("127.0.0.1 localhost\n::1 localhost\n")  # Debian's installer writes it, debootstrap does not
    shutil.copytree(wheels, root / "wheels")
    subprocess.run(["git", "clone", "-q", str(ROOT), root / "src"], check=True)
    return root


def campaign(bare: Bare, *, is_tested: bool) -> Iterator[Claim]:
    seconds, done = bare.run("/src/deploy/install.sh --wheelhouse /wheels --robot robot-1")
    yield Claim("installed from a wheelhouse, no network", "exit 0", f"{seconds:.1f} s", not done.returncode)
    seconds, again = bare.run("/src/deploy/install.sh --wheelhouse /wheels")
    yield Claim("installed again", "exit 0", f"{seconds:.1f} s", not again.returncode)
    _, keyed = bare.run(f"{KEYS} && /src/deploy/install.sh --wheelhouse /wheels --keys /root/keys/bundles/robot-1")
    yield Claim("a fleet's keys made, and put in place", "exit 0", f"exit {keyed.returncode}", not keyed.returncode)
    _, there = bare.run(f"ls -d {STATE} && mapquilt --version && mapquilt config check --config /etc/mapquilt/robot.toml")
    yield Claim(
        "command, service, rules and settings are in place", "all", "all" if not there.returncode else "NOT", not there.returncode
    )
    _, verified = bare.run(
        "systemd-analyze verify /etc/systemd/system/mapquilt@.service 2>&1 | grep -v 'D-Bus\\|SO_PASSCRED' ; true"
    )
    yield Claim("systemd-analyze verify", "says nothing", verified.stdout.strip() or "nothing", not verified.stdout.strip())
    _, exposed = bare.run(
        "systemd-analyze security --offline=true --threshold=20 --no-pager /etc/systemd/system/mapquilt@.service | tail -1"
    )
    level = exposed.stdout.strip().partition(": ")[2]
    yield Claim("systemd-analyze security", "<= 2.0", level, bool(level) and float(level.split()[0]) <= 2.0)
    _, mdwe = bare.run(f'timeout -s TERM 4 python3 -c "{UNDER_MDWE}" | head -1 | grep ready')
    yield Claim(
        "the installed robot comes up, with its settings and keys, under MDWE",
        "ready",
        "ready" if not mdwe.returncode else "NOT",
        not mdwe.returncode,
    )
    yield from checkout(bare, is_tested=is_tested)
    _, gone = bare.run(
        f"/src/deploy/install.sh --uninstall --purge && ! ls -d {STATE} 2>/dev/null && ! getent group mapquilt-keys"
    )
    yield Claim("uninstalled, nothing is left", "nothing", "nothing" if not gone.returncode else "NOT", not gone.returncode)


def checkout(bare: Bare, *, is_tested: bool) -> Iterator[Claim]:
    """The same without installing: a clone, and `./run`."""
    seconds, first = bare.run("cd /src && ./run demo --no-serve --out /root/demo && ls /root/demo/merged.png")
    yield Claim("./run demo in a fresh clone, no network", "<= 60 s", f"{seconds:.1f} s", seconds <= 60 and not first.returncode)
    seconds, second = bare.run("cd /src && ./run demo --no-serve --out /root/demo")
    yield Claim("./run demo again", "<= 30 s", f"{seconds:.1f} s", seconds <= 30 and not second.returncode)
    if is_tested:
        seconds, tests = bare.run("cd /src && ./run test", 3600.0)
        told = re.findall(r"\d+ (?:passed|failed|error).*", tests.stdout)
        yield Claim("./run test", "passes", f"{seconds:.0f} s: {told[-1] if told else 'no test ran'}", not tests.returncode)


if __name__ == "__main__":
    raise SystemExit(main())
