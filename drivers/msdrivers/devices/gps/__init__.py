"""Drivers of satellite receivers: NovAtel OEM4 and successors, NMEA 0183."""

from msdrivers.devices.gps.driver import GpsDriver
from msdrivers.devices.gps.settings import GpsSettings

__all__ = ["GpsDriver", "GpsSettings"]
