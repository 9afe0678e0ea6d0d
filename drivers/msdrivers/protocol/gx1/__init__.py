"""The serial protocol of the MicroStrain 3DM-GX1, from both sides. Pure."""

from msdrivers.protocol.gx1.packets import LAYOUTS, LENGTHS, MEASUREMENTS, CommandByte, Gx1Packet
from msdrivers.protocol.gx1.parser import Gx1Parser
from msdrivers.protocol.gx1.requests import Gx1Request, RequestParser
from msdrivers.protocol.gx1.scaling import EepromAddress, Gains
from msdrivers.protocol.gx1.ticks import TickUnwrapper

__all__ = [
    "LAYOUTS",
    "LENGTHS",
    "MEASUREMENTS",
    "CommandByte",
    "EepromAddress",
    "Gains",
    "Gx1Packet",
    "Gx1Parser",
    "Gx1Request",
    "RequestParser",
    "TickUnwrapper",
]
