"""The bill of materials of what runs on a robot: `requirements.lock` as CycloneDX 1.5, for people who must know what is inside.

    python3 deploy/sbom.py            writes deploy/sbom.json anew; a test says when that is due

Every wheel of a package has a hash of its own; they are listed as the package's distributions.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DEPLOY = Path(__file__).resolve().parent
LOCK, SBOM = DEPLOY.parent / "requirements.lock", DEPLOY / "sbom.json"
LICENSES = {
    "eclipse-zenoh": "EPL-2.0 OR Apache-2.0",
    "msgpack": "Apache-2.0",
    "numpy": "BSD-3-Clause",
    "opencv-python-headless": "Apache-2.0",
    "pyserial": "BSD-3-Clause",
}


def main() -> None:
    SBOM.write_text(as_text(sbom(LOCK.read_text(), own_version())))
    print(f"wrote {SBOM}")


def sbom(lock: str, version: str) -> dict[str, Any]:
    """The same lock gives the same bill: no time, no serial number."""
    parts = [component(*part) for part in locked(lock)]
    own = {"type": "application", "bom-ref": "mapquilt", "name": "mapquilt", "version": version, "licenses": licenses("MIT")}
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.5.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": own},
        "components": parts,
        "dependencies": [{"ref": "mapquilt", "dependsOn": [part["bom-ref"] for part in parts]}],
    }


def locked(lock: str) -> Iterator[tuple[str, str, list[str]]]:
    """(name, version, hashes) of every package."""
    for name, version, rest in re.findall(r"(?m)^([\w.-]+)==([^\s;\\]+)((?:.*\\\n)*.*)$", lock):
        yield name, version, sorted(re.findall(r"sha256:([0-9a-f]{64})", rest))


def component(name: str, version: str, hashes: list[str]) -> dict[str, Any]:
    purl = f"pkg:pypi/{name}@{version}"
    distributions = [
        {
            "type": "distribution",
            "url": purl,
            "hashes": [{"alg": "SHA-256", "content": digest}],
            "comment": "one wheel or archive",
        }
        for digest in hashes
    ]
    return {
        "type": "library",
        "bom-ref": purl,
        "name": name,
        "version": version,
        "licenses": licenses(LICENSES[name]),
        "purl": purl,
        "externalReferences": distributions,
    }


def licenses(expression: str) -> list[dict[str, Any]]:
    return [{"expression": expression}] if " " in expression else [{"license": {"id": expression}}]


def own_version() -> str:
    found = re.search(r'__version__ = "([^"]+)"', (DEPLOY.parent / "agent/__init__.py").read_text())
    assert found
    return found[1]


def as_text(bill: dict[str, Any]) -> str:
    return json.dumps(bill, indent=1) + "\n"


if __name__ == "__main__":
    main()
