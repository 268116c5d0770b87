"""What the configuration means for each room: one function a room."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from agent.config import Config
from agent.mapping.options import MappingOptions
from agent.merging.result import MatchOptions
from agent.runtime.network import NetworkSettings
from hw.device import schemes
from protocol.geometry import SE2

TURN_PER_SPEED = 2.0  # rad/s a m/s: a wheel base of half a metre turns twice as fast as it drives


def wheels_url(config: Config) -> str:
    """The base's URL with the geometry that the settings give; what the URL itself says is left alone."""
    wheels, url = config.wheels, config.wheels.url
    if url.partition(":")[0].lower() not in schemes("wheels"):
        return url
    options = {"ticks": wheels.ticks_per_revolution, "radius": wheels.wheel_radius_m, "track": wheels.track_m}
    given = {name: value for name, value in options.items() if value} | {"v_max": wheels.max_speed_mps}
    words = [f"{name}={value:g}" for name, value in given.items() if f"{name}=" not in url.partition("?")[2]]
    return url + ("&" if "?" in url else "?") + "&".join(words) if words else url


def mapping_options(config: Config) -> MappingOptions:
    lidar, mapping = config.lidar, config.mapping
    more: dict[str, Any] = {"matching_range_m": mapping.max_range_m} if mapping.max_range_m > 0.0 else {}
    return MappingOptions(
        resolution_m=mapping.resolution_m,
        particles=mapping.particles,
        max_speed_m_s=config.wheels.max_speed_mps,
        max_turn_rad_s=TURN_PER_SPEED * config.wheels.max_speed_mps,
        T_base_laser=SE2(lidar.mount_x_m, lidar.mount_y_m, math.radians(lidar.mount_yaw_deg)),
        **more,
    )


def match_options(config: Config) -> MatchOptions:
    matching = config.matching
    return MatchOptions(
        method=matching.method, min_match_factor=matching.min_match_factor, size_tolerance=matching.size_tolerance
    )


def network_settings(config: Config, *, is_router: bool = False) -> NetworkSettings:
    fleet = config.fleet
    return NetworkSettings(
        robot=config.robot.id,
        fleet=fleet.name,
        profile=fleet.profile,
        listen=fleet.listen,
        connect=fleet.connect,
        security=fleet.security,
        allow_open=fleet.allow_open,
        key_file=Path(fleet.key_file) if fleet.key_file else None,
        certificates=Path(fleet.certificates) if fleet.certificates else None,
        is_router=is_router,
    ).checked()
