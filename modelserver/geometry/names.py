"""Names of bodies and frames, `Body:Frame`, and their text in messages."""

from __future__ import annotations

from collections.abc import Sequence

from modelserver.errors import Location, quote

WORLD_UTM = "World:UTM"
WORLD_ENU = "World:ENU"
ODOM = "Odom:Origin"

MAX_LENGTH = 200
"""Of a name of a body, frame or constraint."""

RESERVED_BODIES = ("World", "Odom")
"""Bodies that the server itself provides; a file may not define them."""


def join(body: str, frame: str) -> str:
    return f"{body}:{frame}"


ORIGIN = "Origin"
"""Name of the frame at a body's origin."""

ROS_WORLDS = {"map": WORLD_ENU, "odom": ODOM, "utm": WORLD_UTM}
"""The world frames by their names in ROS (REP-105)."""


def complete(name: str) -> str:
    """Return the full name of a frame. As in ROS, a name without a colon is a world frame, or a body's own frame."""
    if not name or not isinstance(name, str) or ":" in name:
        return name  # what is no text is rejected where a message is made of it
    return ROS_WORLDS.get(name) or join(name, ORIGIN)


def shorten(name: str) -> str:
    """Return the short name of a frame that `complete` completes, or the name itself where there is none."""
    for short, world in ROS_WORLDS.items():
        if name == world:
            return short
    body, _, frame = name.partition(":")
    return body if frame == ORIGIN and body not in ROS_WORLDS else name


def split(name: str) -> tuple[str, str]:
    """Return body and frame of a full name. Raises ValueError where it is not of the form `Body:Frame`."""
    body, colon, frame = name.partition(":")
    if not colon or not body or not frame or ":" in frame:
        raise ValueError(f"{quote(name)} is not of the form Body:Frame")
    return body, frame


def find_problem(name: str) -> str:
    """Return why a name of a body, frame or constraint is not allowed, "" if it is."""
    faults = (
        (not name, "the name is empty"),
        (":" in name, "a name has no colon: it divides body and frame in Body:Frame"),
        (len(name) > MAX_LENGTH, f"a name has at most {MAX_LENGTH} characters"),
        (name.split() != [name], "a name has no white space"),
        (not name.isprintable(), "a name has only printable characters"),
    )
    return next((text for is_wrong, text in faults if is_wrong), "")


def find_body_problem(name: str) -> str:
    """Return why a name of a body is not allowed in a file, "" if it is."""
    return "this name is reserved for the server's world frames" if name in RESERVED_BODIES else find_problem(name)


MAX_LISTED = 12
"""Names that a message lists at most."""


def format_first_location(place: Location) -> str:
    return f" (first at {place})" if str(place) else ""


def format_names(several: Sequence[str]) -> str:
    """Return the first `MAX_LISTED` of several names, with their number."""
    return ", ".join(several[:MAX_LISTED]) + (f", ... ({len(several)} in all)" if len(several) > MAX_LISTED else "")
