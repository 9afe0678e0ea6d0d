"""The serial protocol of the MicroStrain 3DM-GX1, from both sides. Pure."""

from msdrivers.protocol.gx1.packets import DATA, LAYOUTS, LENGTHS, CommandByte, Packet
from msdrivers.protocol.gx1.parser import Gx1Parser
from msdrivers.protocol.gx1.requests import Request, RequestParser
from msdrivers.protocol.gx1.scaling import Address, Gains
from msdrivers.protocol.gx1.ticks import TickWatch

__all__ = [
    "DATA",
    "LAYOUTS",
    "LENGTHS",
    "Address",
    "CommandByte",
    "Gains",
    "Gx1Parser",
    "Packet",
    "Request",
    "RequestParser",
    "TickWatch",
]
