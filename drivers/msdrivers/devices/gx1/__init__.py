"""The MicroStrain 3DM-GX1 inertial unit: its driver, and its hard-iron procedure."""

from msdrivers.devices.gx1.driver import Gx1Driver
from msdrivers.devices.gx1.hard_iron import HardIronProcedure, HardIronResult, HardIronSettings
from msdrivers.devices.gx1.settings import Gx1Settings, HeadingSource

__all__ = ["Gx1Driver", "Gx1Settings", "HardIronProcedure", "HardIronResult", "HardIronSettings", "HeadingSource"]
