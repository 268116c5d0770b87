"""The bill of materials says what the lock says."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LOCK, SBOM = ROOT / "requirements.lock", ROOT / "deploy/sbom.json"


def test_it_is_the_one_that_the_lock_gives() -> None:
    before = SBOM.read_bytes()
    printed = subprocess.run(
        [sys.executable, "-c", "import sbom; print(sbom.as_text(sbom.sbom(sbom.LOCK.read_text(), sbom.own_version())), end='')"],
        cwd=ROOT / "deploy",
        env={"PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        check=True,
    )
    assert printed.stdout == before, "the lock has changed: python3 deploy/sbom.py"


def test_every_locked_package_is_listed_with_its_version_and_all_hashes() -> None:
    parts, lock = json.loads(SBOM.read_text())["components"], LOCK.read_text()
    listed = [f"{part['name']}=={part['version']}" for part in parts]
    assert sorted(listed) == sorted(re.findall(r"(?m)^[\w.-]+==[\w.]+", lock))
    hashes = [ref["hashes"][0]["content"] for part in parts for ref in part["externalReferences"]]
    assert sorted(hashes) == sorted(re.findall(r"sha256:(\w{64})", lock))
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert {part["name"] for part in parts} == {re.split(r"[<>=]", name)[0] for name in wanted}
