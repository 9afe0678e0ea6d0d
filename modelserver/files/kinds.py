"""Detect what a file is by its content, for messages about a file that was given in place of another."""

from __future__ import annotations

import re
from enum import Enum
from typing import Final

EXAMINED_BYTES: Final = 1 << 20
"""Bytes of a file that are examined."""


class FileKind(Enum):
    """What a file is; the value is the text of messages."""

    EMPTY = "the file is empty"
    COMMENTS = "there is nothing in the file but comments"
    VEHICLE = "this is a vehicle file"
    GEOMETRY = "this is a geometry file"
    URDF = "this is a URDF, a geometry file format"
    MIRO_PROCESS = "this is a process file of the original ModelServer (2005)"
    XML = "this is XML"
    LOG = "this is an LCM event log"
    BINARY = "this is not text"
    OTHER = "this is some text"

    @property
    def is_empty(self) -> bool:
        return self in (FileKind.EMPTY, FileKind.COMMENTS)


PROCESS_FIX: Final = (
    "write a vehicle file (docs/vehicle-file.md); these keys replace its parameters: vehicle, geometry, base_frame, "
    "rolling_frame, publish.rate_hz, publish.mode, localization.mode, origin, sensors"
)
"""Fix for a process file, wherever it is given."""

_KEY: Final = re.compile(rb"^([A-Za-z_]+)[ \t]*:(?=\s|$)", re.MULTILINE)
_VEHICLE: Final = frozenset(
    b"vehicle geometry base_frame rolling_frame sensors lcm publish localization drivers".split()
)
_REQUIRED: Final = frozenset((b"vehicle", b"base_frame"))
_GEOMETRY: Final = frozenset((b"bodies", b"constraints", b"templates"))
_FORMAT: Final = re.compile(rb"^modelserver[ \t]*:[ \t]*[\"']?geometry/", re.MULTILINE)
_PROCESS: Final = (b"<config", b"<section", b"<parameter")
_MIRO_GEOMETRY: Final = re.compile(
    rb"BodyName|ConstraintName|FrameName|HTransform|FrameRpyParameters|FrameList|<config_group\b|<!ENTITY"
)
"""In Miro's geometry files and compile-time files, but not in a process file; entities neither."""
_URDF: Final = re.compile(rb"<(\w+:)?robot[\s>]")
_GEOMETRY_PATH: Final = re.compile(rb"^geometry[ \t]*:[ \t]*[\"']?([^\s\"'#]+)", re.MULTILINE)

_LOG: Final = b"\xed\xa1\xda\x01"
"""Sync word of every event of an LCM log."""

_BOMS: Final = (b"\xff\xfe", b"\xfe\xff")


def detect_file_kind(content: bytes) -> FileKind:
    """Return what a file with these bytes is.

    A YAML file with the keys of a vehicle file and those of a geometry file is a vehicle file.
    """
    head = content[:EXAMINED_BYTES]
    if head.startswith(_LOG):
        return FileKind.LOG
    text = head.removeprefix(b"\xef\xbb\xbf").strip()
    if not text:
        return FileKind.EMPTY
    if b"\0" in head[:4096] and not head.startswith(_BOMS):
        return FileKind.BINARY
    if text.startswith(b"<"):
        if all(tag in head for tag in _PROCESS) and not _MIRO_GEOMETRY.search(head):
            return FileKind.MIRO_PROCESS
        return FileKind.URDF if _URDF.search(text) else FileKind.XML
    keys = frozenset(_KEY.findall(head))
    if keys >= _REQUIRED:
        return FileKind.VEHICLE
    if keys & _GEOMETRY or _FORMAT.search(head):
        return FileKind.OTHER if keys & _REQUIRED else FileKind.GEOMETRY
    if len(keys & _VEHICLE) >= 2:
        return FileKind.VEHICLE
    if len(content) <= EXAMINED_BYTES and all(
        line.lstrip().startswith(b"#") for line in text.splitlines() if line.strip()
    ):
        return FileKind.COMMENTS
    return FileKind.OTHER


def find_geometry_path(content: bytes) -> str:
    """Return the path of the geometry file in a vehicle file, empty if there is none."""
    found = _GEOMETRY_PATH.search(content[:EXAMINED_BYTES])
    return found[1].decode(errors="replace") if found else ""
