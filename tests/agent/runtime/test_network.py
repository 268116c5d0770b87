"""Network settings: what cannot work is refused with a sentence, and Zenoh itself accepts every profile."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from agent.runtime.network import PROFILES, NetworkConfigError, NetworkSettings, zenoh_config

ROUTER = ("tcp/10.0.0.1:7447",)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("is_router", [False, True])
def test_zenoh_knows_every_key_of_every_profile(profile: str, is_router: bool) -> None:
    settings = NetworkSettings("r1", profile=profile, connect=ROUTER, allow_open=True, is_router=is_router).checked()
    config = zenoh.Config.from_json5(json.dumps(zenoh_config(settings)))
    assert json.loads(config.get_json("mode")) == settings.mode
    assert json.loads(config.get_json("transport/shared_memory/enabled")) is False
    assert json.loads(config.get_json("routing/interests/timeout")) == 60_000


def test_open_beyond_loopback_must_be_said_on_purpose() -> None:
    for listen in ("tcp/0.0.0.0:7447", "tcp/192.168.1.5:0", "udp/[::]:7447", "tcp/robot.example:7447"):
        with pytest.raises(NetworkConfigError, match="allow_open"):
            NetworkSettings("r1", listen=(listen,)).checked()
    NetworkSettings("r1", listen=("tcp/0.0.0.0:7447",), allow_open=True).checked()
    NetworkSettings("r1", listen=("tcp/127.0.0.1:7447", "tcp/[::1]:0")).checked()
    with pytest.raises(NetworkConfigError, match="allow_open"):
        NetworkSettings("r1", profile="lan").checked()


@pytest.mark.parametrize("name", ["", "-a", "A", "a b", "a/b", "*", "a" * 33, "ü"])
def test_a_name_that_is_no_key_chunk_is_refused(name: str) -> None:
    with pytest.raises(NetworkConfigError, match="robot id"):
        NetworkSettings(name).checked()
    with pytest.raises(NetworkConfigError, match="fleet name"):
        NetworkSettings("r1", fleet=name).checked()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"profile": "wifi"}, "choose one of loopback"),
        ({"security": "none"}, "choose one of open"),
        ({"profile": "infrastructure"}, "needs a router"),
        ({"security": "shared"}, "key file"),
        ({"security": "mtls"}, "certificate directory"),
    ],
)
def test_what_cannot_work_says_what_to_do(change: dict[str, str], said: str) -> None:
    with pytest.raises(NetworkConfigError, match=said):
        replace(NetworkSettings("r1"), **change).checked()  # type: ignore[arg-type]


def test_missing_certificates_name_the_file_and_the_command(tmp_path: Path) -> None:
    settings = NetworkSettings("r1", security="mtls", certificates=tmp_path).checked()
    with pytest.raises(NetworkConfigError, match=r"ca\.pem.*mapquilt fleet enroll r1"):
        zenoh_config(settings)


def test_two_fleets_on_one_network_scout_apart() -> None:
    def address(fleet: str) -> str:
        config = zenoh_config(NetworkSettings("r1", fleet=fleet, profile="lan", allow_open=True).checked())
        return str(config["scouting"]["multicast"]["address"])

    assert address("warehouse") != address("lab")
