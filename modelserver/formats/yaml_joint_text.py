"""Joints as the YAML form writes them, to read back exactly."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from modelserver.formats.saved import plain
from modelserver.geometry.joint import SUFFIXES, Coordinates, Joint, JointType

_UP = (0.0, 0.0, 1.0)


def joint_lines(joint: Joint, text: Callable[[str], str], width: int) -> list[str]:
    """Return the lines of a constraint's joint, none for a fixed one.

    `text` writes a name as YAML, `width` is what a joint on one line may take.
    """
    if not joint.moves:
        return []
    fields = []
    if joint.type in (JointType.REVOLUTE, JointType.PRISMATIC) or joint.axis != _UP:
        fields.append(f"axis: [{', '.join(map(plain, joint.axis))}]")
    if joint.lower or joint.upper:
        lower, upper = joint.lower or (-math.inf,) * joint.count, joint.upper or (math.inf,) * joint.count
        pairs = list(zip(lower, upper, strict=True))
        fields.append(_quantity("limits", joint, [None if pair == (-math.inf, math.inf) else pair for pair in pairs]))
    if joint.rate_limit:
        rates = [None if value == math.inf else (value,) for value in joint.rate_limit]
        fields.append(_quantity("rate_limit", joint, rates))
    for key, values in (("default", joint.default if joint.mimic is None else ()), ("sigma", joint.sigma)):
        if values:
            fields.append(_quantity(key, joint, [(value,) for value in values]))
    if joint.mimic is not None:
        fields.append(_mimic(joint, text))
    if not fields:
        return [f"joint: {joint.type}"]
    fields.insert(0, f"type: {joint.type}")
    short = f"joint: {{{', '.join(fields)}}}"
    return [short] if len(short) <= width else ["joint:", *(f"  {field}" for field in fields)]


def _quantity(key: str, joint: Joint, values: Sequence[Coordinates | None]) -> str:
    """Return `key: value`, a mapping by coordinate where there are several; without those that are None."""
    if joint.count == 1:
        (value,) = values
        assert value is not None
        return _entry(key, value, joint.is_angle[0])
    names = [suffix.removeprefix(".") for suffix in SUFFIXES[joint.type]]
    inside = [
        _entry(name, value, is_angle)
        for name, value, is_angle in zip(names, values, joint.is_angle, strict=True)
        if value is not None
    ]
    return f"{key}: {{{', '.join(inside)}}}"


def _entry(key: str, values: Coordinates, is_angle: bool) -> str:
    degrees = in_degrees(values) if is_angle else None
    if degrees is not None:
        key, values = f"{key}_deg", degrees
    written = [_number(value) for value in values]
    return f"{key}: {written[0]}" if len(written) == 1 else f"{key}: [{', '.join(written)}]"


def _mimic(joint: Joint, text: Callable[[str], str]) -> str:
    assert joint.mimic is not None
    # within braces more than a block's bare text needs quotes
    name = text(joint.mimic.joint)
    name = name if name.replace("_", "").isalnum() else _quoted(name)
    parts = [] if joint.mimic.multiplier == 1.0 else [f"multiplier: {plain(joint.mimic.multiplier)}"]
    if joint.mimic.offset != 0.0:
        parts.append(_entry("offset", (joint.mimic.offset,), joint.is_angle[0]))
    return f"mimic: {{{', '.join([f'joint: {name}', *parts])}}}" if parts else f"mimic: {name}"


def _quoted(name: str) -> str:
    # what `text` had to quote is quoted already; what it left bare holds neither quote nor backslash at a bad place
    return name if name.startswith('"') else '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _number(value: float) -> str:
    return plain(value) if math.isfinite(value) else ".inf" if value > 0 else "-.inf"


def in_degrees(radians: Coordinates) -> Coordinates | None:
    """Return angles in degrees that read back as the same floats, as short as they come; None where none do."""
    degrees = tuple(map(math.degrees, radians))
    for decimals in (6, 12, 17):
        short = tuple([round(value, decimals) for value in degrees])
        if tuple(map(math.radians, short)) == radians:
            return short
    return None
