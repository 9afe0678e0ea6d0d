"""NovAtel OEM4 and successors: logs in binary and ASCII, command responses, prompts."""

from msdrivers.protocol.novatel.frames import (
    AsciiFormat,
    BinaryFormat,
    CommandResponse,
    Prompt,
    PromptFormat,
    TextFormat,
    encode,
)
from msdrivers.protocol.novatel.logs import (
    HeadingLog,
    LogHeader,
    NovatelLog,
    Position,
    PositionType,
    SolutionStatus,
    TimeStatus,
    UtmPosition,
    Velocity,
)

__all__ = [
    "AsciiFormat",
    "BinaryFormat",
    "CommandResponse",
    "HeadingLog",
    "LogHeader",
    "NovatelLog",
    "Position",
    "PositionType",
    "Prompt",
    "PromptFormat",
    "SolutionStatus",
    "TextFormat",
    "TimeStatus",
    "UtmPosition",
    "Velocity",
    "encode",
]
