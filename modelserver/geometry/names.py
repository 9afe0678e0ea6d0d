"""Names of bodies and frames: `Body:Frame`."""

from __future__ import annotations

from modelserver.errors import shown

WORLD_UTM = "World:UTM"
WORLD_ENU = "World:ENU"
ODOM = "Odom:Origin"

MAX_LENGTH = 200
"""Of a name of a body, frame or constraint; it stands in messages, lists and replies."""

RESERVED_BODIES = ("World", "Odom")
"""Bodies that the service itself provides; a file may not define them."""


def joined(body: str, frame: str) -> str:
    """Return the full name of a frame."""
    return f"{body}:{frame}"


def split(name: str) -> tuple[str, str]:
    """Return body and frame of a full name. Raises ValueError where it is not of the form `Body:Frame`."""
    body, colon, frame = name.partition(":")
    if not colon or not body or not frame or ":" in frame:
        raise ValueError(f"{shown(name)} is not of the form Body:Frame")
    return body, frame


def fault(name: str) -> str:
    """Return what is wrong with a name of a body, frame or constraint; empty where nothing is."""
    if not name:
        return "the name is empty"
    if ":" in name:
        return "a name has no colon: it divides body and frame in Body:Frame"
    if len(name) > MAX_LENGTH:
        return f"a name has at most {MAX_LENGTH} characters"
    if any(character.isspace() for character in name):
        return "a name has no white space"
    if not name.isprintable():
        return "a name has only printable characters"
    return ""
