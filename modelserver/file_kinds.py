"""What a file is, by its first bytes: for those that were given in the place of another."""

from __future__ import annotations

import re
import shlex
from enum import Enum
from typing import Final

LOOKED_AT: Final = 1 << 20
"""Bytes of a file that are looked at."""


class FileKind(Enum):
    """What a file is; the value says so in words."""

    EMPTY = "the file is empty"
    COMMENTS = "there is nothing in the file but comments"
    VEHICLE = "this is a vehicle file"
    GEOMETRY = "this is a geometry file"
    URDF = "this is a URDF, a form of geometry file"
    MIRO_PROCESS = "this is a Miro process configuration"
    XML = "this is XML"
    LOG = "this is an LCM event log"
    BINARY = "this is no text"
    OTHER = "this is some text"

    @property
    def is_nothing(self) -> bool:
        """Whether nothing stands in the file."""
        return self in (FileKind.EMPTY, FileKind.COMMENTS)


_KEY: Final = re.compile(rb"^([A-Za-z_]+)[ \t]*:(?=\s|$)", re.MULTILINE)
_VEHICLE: Final = frozenset(
    (
        b"vehicle",
        b"geometry",
        b"base_frame",
        b"rolling_frame",
        b"sensors",
        b"lcm",
        b"publish",
        b"localization",
        b"drivers",
    )
)
_OWN: Final = frozenset((b"vehicle", b"base_frame"))
_GEOMETRY: Final = frozenset((b"bodies", b"constraints", b"templates"))
_FORM: Final = re.compile(rb"^modelserver[ \t]*:[ \t]*[\"']?geometry/", re.MULTILINE)
_PROCESS: Final = (b"<config", b"<section", b"<parameter")
_IN_GEOMETRY: Final = re.compile(
    rb"BodyName|ConstraintName|FrameName|HTransform|FrameRpyParameters|FrameList|<config_group\b|<!ENTITY"
)
"""What Miro's geometry files and its compile-time files hold, and a process configuration does not; nor entities."""
_URDF: Final = re.compile(rb"<(\w+:)?robot[\s>]")
_NAMED: Final = re.compile(rb"^geometry[ \t]*:[ \t]*[\"']?([^\s\"'#]+)", re.MULTILINE)

_LOG: Final = b"\xed\xa1\xda\x01"
"""Every event of an LCM log begins with it."""

_BOMS: Final = (b"\xff\xfe", b"\xfe\xff")


def file_kind(content: bytes) -> FileKind:
    """Return what a file with these bytes is: by what stands in it, for names of files lie.

    A YAML file with a vehicle file's own keys and those of a geometry is a vehicle file.
    """
    head = content[:LOOKED_AT]
    if head.startswith(_LOG):
        return FileKind.LOG
    text = head.removeprefix(b"\xef\xbb\xbf").strip()
    if not text:
        return FileKind.EMPTY
    if b"\0" in head[:4096] and not head.startswith(_BOMS):
        return FileKind.BINARY
    if text.startswith(b"<"):
        if all(tag in head for tag in _PROCESS) and not _IN_GEOMETRY.search(head):
            return FileKind.MIRO_PROCESS
        return FileKind.URDF if _URDF.search(text) else FileKind.XML
    keys = frozenset(_KEY.findall(head))
    if keys >= _OWN:
        return FileKind.VEHICLE
    if keys & _GEOMETRY or _FORM.search(head):
        return FileKind.OTHER if keys & _OWN else FileKind.GEOMETRY
    if len(keys & _VEHICLE) >= 2:
        return FileKind.VEHICLE
    if len(content) <= LOOKED_AT and all(line.lstrip().startswith(b"#") for line in text.splitlines() if line.strip()):
        return FileKind.COMMENTS
    return FileKind.OTHER


def conversion_command(path: str) -> str:
    """Return the command that converts the Miro process configuration at a path to a vehicle file beside it."""
    stem = path[:-4] if path.lower().endswith(".xml") else path
    return shlex.join(["modelserver", "convert", path, f"{stem}.yaml"])


def geometry_named(content: bytes) -> str:
    """Return the geometry file that a vehicle file names, empty where that cannot be read."""
    found = _NAMED.search(content[:LOOKED_AT])
    return found[1].decode(errors="replace") if found else ""
