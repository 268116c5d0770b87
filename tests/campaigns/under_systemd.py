"""The installed service under a real systemd: a bare Debian boots with it as PID 1; the robot is started, killed, hung, stopped.

    .venv/bin/python -m tests.campaigns.under_systemd [--release bookworm] [--base DIR] [--wheels DIR] [--json]

Needs root, debootstrap and a kernel with cgroup v2; no container program.  The system boots in namespaces of its own (processes,
mounts, network, cgroups), its LIDAR is simulated, and nothing of the host is touched.
"""

from __future__ import annotations

import contextlib
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from tests.campaigns.bare_debian import KEYS, Bare, bare_debian, options
from tests.campaigns.claims import Claim, judged

SERVICE = "mapquilt@robot-1"
INSTALL = "/src/deploy/install.sh --wheelhouse /wheels"
WITH_KEYS = f"{KEYS} && {INSTALL} --keys keys/bundles/robot-1"
SIMULATED = (
    'sed -i -e \'s|^url = "rplidar:.*|url = "sim:office?seed=3"|\' -e \'s|^url = "wheels:.*|url = ""|\' /etc/mapquilt/robot.toml'
)
BOOT = """
set -e
mount --make-rprivate / && mount --bind "$0" "$0" && cd "$0"
mount -t proc proc proc && mount -t sysfs -o ro sysfs sys && mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs -o mode=755 tmpfs run && mount -t tmpfs -o mode=1777 tmpfs tmp && mount -t tmpfs -o mode=755 tmpfs dev
for node in null zero full random urandom tty; do touch dev/$node; mount --bind /dev/$node dev/$node; done
mkdir dev/pts dev/shm old
mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts dev/pts && ln -s pts/ptmx dev/ptmx && ln -s /proc/self/fd dev/fd
mount -t tmpfs tmpfs dev/shm && ip link set lo up && hostname bare && pivot_root . old && umount -l /old
exec env -i container=campaign PATH=/usr/sbin:/usr/bin:/sbin:/bin /lib/systemd/systemd --system --unit=multi-user.target
"""
NAMESPACES = ["--pid", "--mount", "--net", "--uts", "--ipc", "--cgroup", "--fork", "--kill-child"]


class Booted:
    """A system whose PID 1 is systemd; commands are run inside."""

    def __init__(self, pid: int) -> None:
        self._pid = str(pid)

    def run(self, command: str) -> subprocess.CompletedProcess[str]:
        env = ["env", "-i", "PATH=/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "HOME=/root"]
        words = ["nsenter", "--target", self._pid, "--all", *env, "sh", "-c", command]
        return subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)

    def asked(self, name: str) -> str:
        return self.run(f"systemctl show --property {name} --value {SERVICE}").stdout.strip()

    def timed(self, command: str) -> tuple[float, bool]:
        started_s = time.monotonic()
        is_done = not self.run(command).returncode
        return time.monotonic() - started_s, is_done

    def back_after(self, signal_name: str) -> tuple[float, bool]:
        """From a signal to the robot's process until another one says READY."""
        before, started_s = self.asked("MainPID"), time.monotonic()
        self.run(f"kill -{signal_name} {before}")
        while time.monotonic() < started_s + 60:
            if self.asked("MainPID") not in (before, "0") and self.asked("ActiveState") == "active":
                return time.monotonic() - started_s, True
            time.sleep(0.05)
        return time.monotonic() - started_s, False


def main(argv: list[str] | None = None) -> int:
    args = options(__doc__).parse_args(argv)
    with bare_debian(args) as root:
        _, installed = Bare(root).run(f"{INSTALL} && {WITH_KEYS} && {SIMULATED}")
        with booted(root) as system:
            claims = [Claim("installed, offline", "exit 0", f"exit {installed.returncode}", not installed.returncode)]
            claims += story(system)
    return judged(claims, as_json=args.json)


@contextlib.contextmanager
def booted(root: Path) -> Iterator[Booted]:
    """The system, up; taken down with everything in it at the end."""
    outer = subprocess.Popen(["unshare", *NAMESPACES, "sh", "-c", BOOT, str(root)], stderr=subprocess.DEVNULL)
    try:
        deadline_s = time.monotonic() + 60
        while time.monotonic() < deadline_s:
            children = Path(f"/proc/{outer.pid}/task/{outer.pid}/children").read_text().split()
            if children and Path(f"/proc/{children[0]}/comm").read_text().strip() == "systemd":
                system = Booted(int(children[0]))
                if system.run("systemctl is-system-running --wait").stdout.strip() in ("running", "degraded"):
                    yield system
                    return
            time.sleep(0.1)
        raise AssertionError("systemd did not come up as PID 1 within 60 s")
    finally:
        outer.kill()
        outer.wait()


def story(system: Booted) -> Iterator[Claim]:
    seconds, is_up = system.timed(f"systemctl enable --now {SERVICE}")
    yield Claim("systemctl enable --now, until READY", "<= 10 s", f"{seconds:.1f} s", is_up and seconds <= 10)
    who = system.run(f"stat -c %u /proc/{system.asked('MainPID')}").stdout.strip()
    yield Claim("its user", "not root", f"uid {who}", who not in ("", "0"))
    is_seen = "robot-1  up" in system.run("sleep 2; mapquilt status").stdout
    yield Claim("sudo mapquilt status sees it", "yes", "yes" if is_seen else "NO", is_seen)
    seconds, is_back = system.back_after("KILL")
    yield Claim("kill -9, until READY again", "<= 5 s", f"{seconds:.1f} s", is_back and seconds <= 5)
    seconds, is_back = system.back_after("STOP")
    yield Claim("hung (SIGSTOP): the watchdog, until READY again", "<= 20 s", f"{seconds:.1f} s", is_back and seconds <= 20)
    traced = system.run(f"journalctl --unit {SERVICE} --no-pager | grep -c 'most recent call first'").stdout.strip()
    yield Claim("what every thread did then is in the journal", "threads", f"{traced} threads", int(traced or 0) > 3)
    time.sleep(3.0)
    seconds, is_done = system.timed(f"systemctl restart {SERVICE}")
    is_kept = "restored the local map" in system.run(f"journalctl --unit {SERVICE} --no-pager").stdout
    yield Claim("systemctl restart; its map is there again", "<= 10 s", f"{seconds:.1f} s", is_done and is_kept and seconds <= 10)
    seconds, _ = system.timed(f"systemctl stop {SERVICE}")
    result = system.asked("Result")
    yield Claim("systemctl stop", "<= 2 s, success", f"{seconds:.1f} s, {result}", seconds <= 2 and result == "success")


if __name__ == "__main__":
    raise SystemExit(main())
