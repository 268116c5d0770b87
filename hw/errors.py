"""What can go wrong with a device; every message says where, what was seen, and what to try next.

DeviceError
  DeviceConfigError    the URL or an option is wrong: the only one that stops a program
  DeviceAbsent         the port is not there, or may not be opened
  DeviceSilent         it is open, but nothing comes
  DeviceGarbled        bytes come, but they make no sense
"""

from __future__ import annotations


class DeviceError(Exception):
    """Root of everything this room raises."""


class DeviceConfigError(DeviceError):
    """The device URL or one of its options cannot work."""


class DeviceAbsent(DeviceError):
    """The port does not exist or may not be opened."""


class DeviceSilent(DeviceError):
    """The port is open, but no bytes come."""


class DeviceGarbled(DeviceError):
    """Bytes come, but no valid frame is among them."""
