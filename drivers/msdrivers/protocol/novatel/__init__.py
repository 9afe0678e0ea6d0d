"""NovAtel OEM4 and its heirs: logs in binary and ASCII, answers to commands, prompts."""

from msdrivers.protocol.novatel.frames import Answer, AsciiFormat, BinaryFormat, Prompt, PromptFormat, TextFormat
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
    "Answer",
    "AsciiFormat",
    "BinaryFormat",
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
]
