"""`mapquilt fleet`: the keys of a fleet, made and kept on the operator's laptop.

    DIR/fleet.key  DIR/ca.pem  DIR/ca.key         ca.key never leaves this directory
    DIR/members.json                              who belongs to the fleet
    DIR/bundles/<robot>/                          what is copied to that robot: fleet.key, ca.pem, its certificate, acl.json

Every robot carries the rules of the whole fleet (acl.json), because between peers the receiver is the one who checks: after
enrolling or revoking a member all bundles are written anew, and take effect when a robot is started again.  Revoking draws a
new fleet.key, too: robots with `security = "shared"` hear one another again once all have it.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import shutil
import subprocess
from pathlib import Path
from typing import Any

from agent.exits import BAD_INPUT, ENVIRONMENT, OK, USAGE, CommandError
from protocol.channels import fleet_key, robot_key
from protocol.names import is_robot_id

EXAMPLES = """\
  mapquilt fleet init keys --fleet warehouse      once, on the operator's laptop
  mapquilt fleet enroll keys robot-1 robot-2      makes keys/bundles/robot-1, keys/bundles/robot-2
  mapquilt fleet enroll keys base --router        a router may carry everybody's words
  mapquilt fleet revoke keys robot-2              the others no longer hear it, once they have the new bundles
"""

CA_DAYS, MEMBER_DAYS = 3650, 825
WRITES = ["put", "delete", "reply", "declare_queryable", "liveliness_token"]
READS = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=("init", "enroll", "revoke", "list"))
    parser.add_argument("folder", type=Path, metavar="DIR", help="where the keys are kept; back it up, show it to nobody")
    parser.add_argument("names", nargs="*", default=[], metavar="ROBOT", help="robots to enroll or revoke")
    parser.add_argument("--fleet", default="mapquilt", metavar="NAME", help="the fleet's name (init)")
    parser.add_argument("--router", action="store_true", help="these are routers (enroll)")


def run(args: argparse.Namespace) -> int:
    if args.action == "init":
        init(args.folder, args.fleet)
        said = f"a fleet '{args.fleet}' in {args.folder}; now: mapquilt fleet enroll {args.folder} ROBOT ..."
    else:
        members = load(args.folder)
        said = act(args, members)
    if not args.quiet:
        print(said)
    return OK


def act(args: argparse.Namespace, members: dict[str, Any]) -> str:
    if args.action == "list":
        return "\n".join(f"{name} {entry['role']}" for name, entry in sorted(members["members"].items())) or "nobody yet"
    if not args.names:
        raise CommandError(f"mapquilt fleet {args.action}: which robot?", USAGE)
    for name in args.names:
        if not is_robot_id(name):
            raise CommandError(f"{name!r}: use 1 to 32 of a-z, 0-9, '-' and '_', starting with a letter or digit", USAGE)
        if args.action == "enroll":
            enroll(args.folder, name)
            members["members"][name] = {"role": "router" if args.router else "robot"}
        elif members["members"].pop(name, None) is None:
            raise CommandError(f"{name} is no member; mapquilt fleet list {args.folder}", USAGE)
        else:
            shutil.rmtree(args.folder / "bundles" / name, ignore_errors=True)
    if args.action == "revoke":
        draw_secret(args.folder)
    write_private(args.folder / "members.json", json.dumps(members, indent=1).encode())
    spread(args.folder, members)
    verb = "enrolled" if args.action == "enroll" else "revoked"
    return f"{verb} {', '.join(args.names)}; copy {args.folder}/bundles/<robot> to every robot and start it again"


def init(folder: Path, fleet: str) -> None:
    if not is_robot_id(fleet):
        raise CommandError(f"fleet name {fleet!r}: use 1 to 32 of a-z, 0-9, '-' and '_'", USAGE)
    if (folder / "members.json").exists():
        raise CommandError(f"{folder} holds a fleet already; enroll into it, or choose another directory", USAGE)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    draw_secret(folder)
    openssl("ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", folder / "ca.key")
    subject = ("-subj", f"/CN=mapquilt fleet {fleet}")
    openssl("req", "-x509", "-new", "-key", folder / "ca.key", "-days", CA_DAYS, *subject, "-out", folder / "ca.pem")
    (folder / "ca.key").chmod(0o600)
    write_private(folder / "members.json", json.dumps({"fleet": fleet, "members": {}}, indent=1).encode())


def draw_secret(folder: Path) -> None:
    """A new `fleet.key`; who was revoked knows the old one."""
    write_private(folder / "fleet.key", secrets.token_hex(32).encode() + b"\n")


def enroll(folder: Path, robot: str) -> None:
    """A key and a certificate whose name is the robot's id."""
    bundle = folder / "bundles" / robot
    bundle.mkdir(mode=0o700, parents=True, exist_ok=True)
    request, extensions = bundle / "request.pem", bundle / "extensions.cnf"
    openssl("ecparam", "-name", "prime256v1", "-genkey", "-noout", "-out", bundle / f"{robot}.key")
    openssl("req", "-new", "-key", bundle / f"{robot}.key", "-subj", f"/CN={robot}", "-out", request)
    extensions.write_text(f"subjectAltName=DNS:{robot}\nextendedKeyUsage=serverAuth,clientAuth\nbasicConstraints=CA:FALSE\n")
    signed_by = ("-CA", folder / "ca.pem", "-CAkey", folder / "ca.key", "-set_serial", f"0x{secrets.token_hex(16)}")
    more = ("-days", MEMBER_DAYS, "-extfile", extensions, "-out", bundle / f"{robot}.pem")
    openssl("x509", "-req", "-in", request, *signed_by, *more)
    (bundle / f"{robot}.key").chmod(0o600)
    request.unlink()
    extensions.unlink()


def spread(folder: Path, members: dict[str, Any]) -> None:
    """The rules and the fleet's key into every bundle."""
    rules = json.dumps(access_control(members["fleet"], members["members"]), indent=1).encode()
    for name in members["members"]:
        bundle = folder / "bundles" / name
        write_private(bundle / "acl.json", rules)
        for file in ("fleet.key", "ca.pem"):
            write_private(bundle / file, (folder / file).read_bytes())


def access_control(fleet: str, members: dict[str, Any]) -> dict[str, Any]:
    """Zenoh's access rules: nobody does anything, except that members read the fleet, and each writes its own subtree.

    `**` does not match a chunk that begins with `@`, so the admin space stays closed and our keys are written out.
    """
    everything = [fleet_key(fleet)]
    rules = [
        {"id": "say", "messages": WRITES + READS, "flows": ["egress"], "permission": "allow", "key_exprs": everything},
        {"id": "read", "messages": READS, "flows": ["ingress"], "permission": "allow", "key_exprs": everything},
        {"id": "carry", "messages": WRITES, "flows": ["ingress"], "permission": "allow", "key_exprs": everything},
    ]
    subjects: list[dict[str, Any]] = [{"id": "anybody"}]
    policies: list[dict[str, Any]] = [{"rules": ["say"], "subjects": ["anybody"]}]
    for name, entry in sorted(members.items()):
        subjects.append({"id": name, "cert_common_names": [name]})
        own = [robot_key(fleet, name, "**"), fleet_key(fleet, f"r/{name}-prior$*/**")]
        rules.append({"id": f"write-{name}", "messages": WRITES, "flows": ["ingress"], "permission": "allow", "key_exprs": own})
        allowed = ["read", "carry"] if entry["role"] == "router" else ["read", f"write-{name}"]
        policies.append({"rules": allowed, "subjects": [name]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def load(folder: Path) -> dict[str, Any]:
    try:
        members = json.loads((folder / "members.json").read_text())
        if isinstance(members, dict) and isinstance(members.get("members"), dict) and is_robot_id(str(members.get("fleet"))):
            return members
    except FileNotFoundError as error:
        raise CommandError(f"{folder} holds no fleet; mapquilt fleet init {folder}", BAD_INPUT) from error
    except (OSError, ValueError) as error:
        raise CommandError(f"{folder}/members.json cannot be read: {error}", BAD_INPUT) from error
    raise CommandError(f"{folder}/members.json is not a fleet's list; restore it from your backup", BAD_INPUT)


def write_private(path: Path, data: bytes) -> None:
    """For the owner's eyes only, from the first byte on."""
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)


def openssl(*words: object) -> None:
    try:
        done = subprocess.run(["openssl", *map(str, words)], capture_output=True, check=False)
    except FileNotFoundError as error:
        raise CommandError("openssl is not installed; on Debian: apt install openssl", ENVIRONMENT) from error
    if done.returncode != 0:
        raise CommandError(f"openssl {words[0]} failed: {done.stderr.decode(errors='replace').strip()[-300:]}", ENVIRONMENT)
