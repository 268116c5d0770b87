"""`mapquilt config`: what is in force, told so that it can be used again."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

from agent.config import Config, keys
from tests.agent.commands.conftest import Run


def test_what_is_shown_is_a_settings_file_that_gives_the_same(run: Run, tmp_path: Path) -> None:
    first = run(
        "config", "show", "--id", "r1", "--connect", "tcp/10.0.0.1:7447", "--connect", "tcp/ä:1", "--set", 'lidar.url=a"\\b'
    )
    (tmp_path / "again.toml").write_text(first.out)
    assert run("config", "show", "--config", tmp_path / "again.toml").out == first.out
    table = tomllib.loads(first.out)
    assert {f"{section}.{key}" for section in table for key in table[section]} == set(keys())
    assert table["fleet"]["connect"] == ["tcp/10.0.0.1:7447", "tcp/ä:1"]


def test_origins_say_who_set_what(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[view]\nport = 9000\n")
    out = run("config", "show", "--origin", "--config", file, "--lidar", "sim:office", "--no-view").out
    assert f"port = 9000 # {file}" in " ".join(out.split())
    assert 'url = "sim:office" # --lidar' in " ".join(out.split())
    assert "enabled = false # --no-view" in " ".join(out.split())
    tomllib.loads(out)


def test_json_has_values_and_origins(run: Run) -> None:
    shown = json.loads(run("config", "--json", "--set", "mapping.particles=7").out)
    assert shown["mapping.particles"] == {"value": 7, "origin": "--set"}
    assert shown["mapping.resolution_m"] == {"value": Config().mapping.resolution_m, "origin": "default"}


def test_check_is_silent_or_says_what_is_wrong(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[matching]\nmin_factor = 0.9\n")
    ended = run("config", "check", "--config", file)
    assert (ended.code, ended.out) == (2, "")
    assert ended.err == f"mapquilt: {file}: unknown key 'matching.min_factor'; did you mean 'matching.min_match_factor'?\n"
    file.write_text("")
    ended = run("config", "check", "--config", file)
    assert (ended.code, ended.out, ended.err) == (0, "", "")


def test_check_finds_what_a_start_would_refuse(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    for written, said in (
        ('[lidar]\nurl = "ld05:/dev/ttyUSB0"', "'ld05' is no kind of lidar"),
        ('[lidar]\nurl = "/dev/ttyUSB0"', "is no device URL"),
        ('[wheels]\nurl = "arduino:/dev/ttyACM0"', "arduino:/dev/ttyACM0"),
        ('[fleet]\nsecurity = "shared"', "mapquilt fleet init"),
        ('[fleet]\nprofile = "lan"', "allow_open"),
    ):
        file.write_text(written)
        ended = run("config", "check", "--config", file)
        assert (ended.code, ended.out, said in ended.err) == (2, "", True), ended.err


def test_the_sample_settings_pass_the_check(run: Run) -> None:
    assert run("config", "check", "--config", Path(__file__).parents[3] / "deploy" / "robot.toml").code == 0
