"""A robot without settings: ask every serial port who is there, and take the first LIDAR and the first base that answer."""

from __future__ import annotations

import logging
from dataclasses import replace

from agent.config import Config
from agent.exits import ENVIRONMENT, USAGE, CommandError
from hw.probing import SerialPortInfo, probe, serial_ports

log = logging.getLogger(__name__)


def with_what_is_plugged_in(config: Config) -> Config:
    """The settings with the devices that answered; a base that was named is kept, and its port is left alone."""
    ports = [port for port in serial_ports() if port.device not in config.wheels.url]
    if not ports:
        raise CommandError(
            "no LIDAR named, and no serial port to look for one; plug it in, or try --lidar sim:office (a simulated one)", USAGE
        )
    lidar, wheels = "", config.wheels.url
    for port in ports:
        if lidar and wheels:
            break
        kind, url = _who_is_at(port)
        if kind == "lidar":
            lidar = lidar or url
        elif kind == "wheels":
            wheels = wheels or url
    if not lidar:
        asked = ", ".join(port.device for port in ports)
        raise CommandError(f"no LIDAR answered on {asked}; name it with --lidar KIND:PORT, or see: mapquilt doctor", ENVIRONMENT)
    return replace(config, lidar=replace(config.lidar, url=lidar), wheels=replace(config.wheels, url=wheels))


def _who_is_at(port: SerialPortInfo) -> tuple[str, str]:
    """("lidar" or "wheels" or "", URL by the name that stays)."""
    if port.used_by:
        log.warning("%s is in use by %s: passed over", port.device, port.used_by)
        return "", ""
    log.info("%s: listening for a LIDAR or a base", port.device)
    answer = probe(port.device)
    if answer is None:
        log.info("%s: nobody we know", port.device)
        return "", ""
    url = answer.url.replace(port.device, port.by_path or port.device, 1)
    log.info("%s: %s %s", port.device, answer.health.model, url)
    return answer.kind, url
