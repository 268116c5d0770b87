"""Settings: everything works with none, the later source wins, and a mistake is answered with what was meant."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from agent.config import Config, ConfigError, control_socket, default_robot_id, keys, state_dir
from agent.config_sources import assignment, load_config
from protocol.names import is_robot_id


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """An environment without any configuration, also where a robot is installed."""
    monkeypatch.setattr("agent.config_sources.SYSTEM_CONFIG", tmp_path / "etc" / "robot.toml")
    return {"HOME": str(tmp_path / "home"), "XDG_CONFIG_HOME": str(tmp_path / "config")}


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def complaint(file: Path | None, environ: dict[str, str], *flags: tuple[str, str, object]) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(file, flags, environ)
    return str(caught.value)


def test_everything_works_with_no_configuration(home: dict[str, str]) -> None:
    loaded = load_config(environ=home)
    named = dataclasses.replace(Config(), robot=loaded.config.robot)
    assert loaded.config == named
    assert loaded.config.robot.id == default_robot_id()
    assert loaded.origins["robot.id"] == "host name"
    assert set(loaded.origins.values()) == {"default", "host name"}


def test_every_default_is_a_value_that_may_be_written(home: dict[str, str]) -> None:
    flags = [("--set", key.name, key.default) for key in keys().values()]
    assert load_config(flags=flags, environ=home).config == load_config(environ=home).config


def test_the_id_of_any_host_can_stand_in_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    for host in ("Robot_7.lan", "-", "", "été", "x" * 64, "a b/*$#"):
        monkeypatch.setattr("socket.gethostname", lambda host=host: host)
        assert is_robot_id(default_robot_id()), host


def test_an_installed_robot_reads_the_file_of_the_system(home: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    write(tmp_path / "etc" / "robot.toml", '[robot]\nid = "r9"\n')
    assert load_config(environ=home).config.robot.id == "r9"


def test_file_then_environment_then_flags(home: dict[str, str], tmp_path: Path) -> None:
    file = write(tmp_path / "robot.toml", "[mapping]\nparticles = 10\nresolution_m = 0.1\nseed = 5\n")
    home |= {"MAPQUILT_MAPPING__PARTICLES": "20", "MAPQUILT_MAPPING__SEED": "6"}
    loaded = load_config(file, [("--seed", "mapping.seed", "7")], home)
    assert (loaded.config.mapping.resolution_m, loaded.config.mapping.particles, loaded.config.mapping.seed) == (0.1, 20, 7)
    assert loaded.origins["mapping.resolution_m"] == str(file)
    assert loaded.origins["mapping.particles"] == "$MAPQUILT_MAPPING__PARTICLES"
    assert loaded.origins["mapping.seed"] == "--seed"


def test_a_list_is_written_with_commas_in_the_environment(home: dict[str, str], tmp_path: Path) -> None:
    file = write(tmp_path / "robot.toml", '[fleet]\nlisten = ["tcp/0.0.0.0:7447"]\n')
    home["MAPQUILT_FLEET__CONNECT"] = "tcp/10.0.0.1:7447, tcp/10.0.0.2:7447"
    fleet = load_config(file, environ=home).config.fleet
    assert fleet.listen == ("tcp/0.0.0.0:7447",)
    assert fleet.connect == ("tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447")


def test_the_file_of_the_user_is_found(home: dict[str, str], tmp_path: Path) -> None:
    place = tmp_path / "config" / "mapquilt" / "config.toml"
    place.parent.mkdir(parents=True)
    write(place, '[robot]\nid = "r7"\n')
    loaded = load_config(environ=home)
    assert (loaded.config.robot.id, loaded.file) == ("r7", place)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[matching]\nmin_factor = 0.9", "unknown key 'matching.min_factor'; did you mean 'matching.min_match_factor'?"),
        ("[mapping]\nmin_match_factor = 0.9", "did you mean 'matching.min_match_factor'?"),
        ("[maping]\nparticles = 3", "did you mean 'mapping.particles'?"),
        ("[robot]\nname = 'r1'", "[robot] has 'robot.id' only"),
        ("[nonsense]", "unknown section [nonsense]; sections are [robot], [lidar]"),
        ("[nonsense]\nzzz = 1", "unknown key 'nonsense.zzz'; sections are [robot]"),
        ("particles = 3", "'particles' stands outside of any section; did you mean 'mapping.particles'?"),
        ("[mapping]\nparticles = 'many'", "mapping.particles = 'many': expected a whole number from 1 to 1000"),
        ("[mapping]\nparticles = 3.5", "mapping.particles = 3.5: expected a whole number"),
        ("[mapping]\nparticles = true", "mapping.particles = True: expected a whole number"),
        ("[mapping]\nparticles = 0", "mapping.particles = 0: expected a whole number from 1 to 1000"),
        ("[mapping]\nresolution_m = nan", "mapping.resolution_m = nan: expected a number from 0.01 to 1"),
        ("[mapping]\nresolution_m = [1]", "expected a number"),
        ("[view]\nenabled = 'perhaps'", "view.enabled = 'perhaps': expected true or false"),
        ("[view]\nenabled = 1", "view.enabled = 1: expected true or false"),
        ("[fleet]\nprofile = 'infra'", "expected one of loopback, lan, radio, infrastructure"),
        ("[fleet]\nprofile = 'infrastructur'", "did you mean 'infrastructure'?"),
        ("[fleet]\nlisten = [1]", "fleet.listen = [1]: expected a list of texts"),
        ("[lidar]\nurl = 3", "lidar.url = 3: expected text"),
        ("[robot]\nid = 'R 2'", "robot.id = 'R 2': use 1 to 32 of a-z"),
        ("[robot\nid", "not valid TOML"),
        ("a = " + "[" * 5000, "not valid TOML"),
    ],
)
def test_a_mistake_is_answered_with_where_and_what_was_meant(text: str, said: str, home: dict[str, str], tmp_path: Path) -> None:
    file = write(tmp_path / "robot.toml", text)
    message = complaint(file, home)
    assert message.startswith(str(file))
    assert said in message


def test_a_mark_of_a_windows_editor_is_passed_over(home: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_bytes(b"\xef\xbb\xbf[view]\r\nport = 9000\r\n")
    assert load_config(tmp_path / "robot.toml", environ=home).config.view.port == 9000


def test_a_mistake_in_the_environment_names_the_variable(home: dict[str, str]) -> None:
    home["MAPQUILT_VIEW__PROT"] = "80"
    assert complaint(None, home) == "$MAPQUILT_VIEW__PROT: unknown key 'view.prot'; did you mean 'view.port'?"


def test_a_mistake_in_a_flag_names_the_flag(home: dict[str, str]) -> None:
    assert complaint(None, home, ("--view-port", "view.port", "99999")).startswith("--view-port: view.port = 99999: expected")
    with pytest.raises(ConfigError, match=r"expected section\.key=value"):
        assignment("--set", "matching.method")


def test_a_file_that_was_asked_for_must_be_there(home: dict[str, str], tmp_path: Path) -> None:
    assert "No such file" in complaint(tmp_path / "none.toml", home)
    assert "Is a directory" in complaint(tmp_path, home)
    assert complaint(write(tmp_path / "zeros.toml", "\0" * 100), home).endswith("(at line 1, column 1)")
    big = write(tmp_path / "big.toml", "#" * (1 << 21))
    assert "is this really a settings file?" in complaint(big, home)


def test_state_and_sockets_lie_where_systemd_or_xdg_say(home: dict[str, str]) -> None:
    config = load_config(flags=[("--id", "robot.id", "r1")], environ=home).config
    assert state_dir(config, {"HOME": "/h"}) == Path("/h/.local/state/mapquilt/r1")
    assert state_dir(config, {"HOME": "/h", "XDG_STATE_HOME": "/s"}) == Path("/s/mapquilt/r1")
    assert state_dir(config, {"STATE_DIRECTORY": "/var/lib/mapquilt/r1"}) == Path("/var/lib/mapquilt/r1")
    assert control_socket("r1", {"RUNTIME_DIRECTORY": "/run/mapquilt"}) == Path("/run/mapquilt/r1.sock")
    assert control_socket("r1", {"XDG_RUNTIME_DIR": "/run/user/7"}) == Path("/run/user/7/mapquilt/r1.sock")
