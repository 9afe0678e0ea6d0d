"""Numbers and rotations as files write them: strict about what is meant, forgiving about rounding."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from modelserver.errors import Location, shown
from modelserver.geometry.builder import ModelBuilder
from modelserver.spatial import so3
from modelserver.spatial.so3 import Quaternion

SILENT_DEVIATION = 1e-3
"""Rotations off by up to this (largest entry of |R'R - I|) are mended without a word: three-decimal
rows such as the report's 0.978 / 0.208 stay below it."""

GREATEST_DEVIATION = 0.05
"""Rotations off by more are refused: that is a slip, no rounding."""

GREATEST_LENGTH = 1e9
"""Positions beyond this many metres are refused; they would lose the millimetres of everything else."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


def parse(text: str, where: str = "") -> float:
    """Return the finite number that `text` writes.

    Raises ValueError that says why it is none, begun with `where`.
    """
    if _NUMBER.fullmatch(text):
        value = float(text)
        if math.isfinite(value):
            return value
        raise ValueError(f"{where}{shown(text, 40)} is too large for a number")
    if text.lower().lstrip("+-.") in ("nan", "inf", "infinity"):
        raise ValueError(f"{where}{shown(text, 40)} is not a finite number")
    if "," in text:
        raise ValueError(f"{where}{shown(text, 40)} is not a number (decimals take a point, and spaces divide numbers)")
    raise ValueError(f"{where}{shown(text, 40)} is not a number")


def within_reach(position: Sequence[float], builder: ModelBuilder, source: Location) -> bool:
    """Return whether a position is near enough to compute with; report it where it is not."""
    if all(abs(value) <= GREATEST_LENGTH for value in position):
        return True
    far = max(position, key=abs)
    builder.error(
        f"the position {far:g} m is out of reach; the limit is {GREATEST_LENGTH:g} m",
        source,
        "positions are in metres; look for a slip in the exponent",
    )
    return False


def rotation(rows: Sequence[Sequence[float]], builder: ModelBuilder, source: Location, where: str) -> Quaternion | None:
    """Return the rotation nearest to three rows of three numbers.

    What is off by more than `SILENT_DEVIATION` is reported as a warning; None, and an error, where no
    rotation can be meant. `where` names the rows for the fix, e.g. `Row1 to Row3`.
    """
    (a, b, c), (d, e, f), (g, h, i) = rows
    if (a, b, c, d, e, f, g, h, i) == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0):
        return so3.IDENTITY
    products = (
        a * a + d * d + g * g - 1.0,
        b * b + e * e + h * h - 1.0,
        c * c + f * f + i * i - 1.0,
        a * b + d * e + g * h,
        a * c + d * f + g * i,
        b * c + e * f + h * i,
    )
    # written so that a product that overflowed to nan counts as too far off
    if not all(abs(value) <= GREATEST_DEVIATION for value in products):
        worst = max((abs(value) for value in products), key=lambda value: math.inf if math.isnan(value) else value)
        builder.error(
            f"this is no rotation: |R'R - I| is {worst:.3g}, more than {GREATEST_DEVIATION:g}",
            source,
            f"look for a wrong digit or sign in {where}: each row and column has length 1, at right angles",
        )
        return None
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
        builder.error(
            "this is a reflection, not a rotation (determinant -1): one axis points the wrong way",
            source,
            f"turn the sign of one row or column in {where}; axes are right-handed",
        )
        return None
    deviation = max(abs(value) for value in products)
    if deviation < 1e-14:
        # written at full precision: the mending would cost time and change nothing
        return so3.from_matrix(rows)
    matrix, deviation = so3.nearest_rotation(rows)
    if deviation > SILENT_DEVIATION:
        moved = float(np.abs(matrix - np.asarray(rows)).max())
        builder.warning(
            f"this is not quite a rotation: |R'R - I| is {deviation:.2g}, more than {SILENT_DEVIATION:g}; "
            f"mended to the nearest one, entries changed by up to {moved:.2g}",
            source,
            f"write {where} with more digits, or look for a slip in one of them",
        )
    return so3.from_matrix(matrix)


def quaternion(wxyz: Sequence[float], builder: ModelBuilder, source: Location) -> Quaternion | None:
    """Return the unit quaternion nearest to four numbers, w first; judged as `rotation`, by its squared length."""
    w, x, y, z = wxyz
    deviation = abs(w * w + x * x + y * y + z * z - 1.0)
    if not deviation <= GREATEST_DEVIATION:
        builder.error(
            f"the quaternion has length {math.hypot(w, x, y, z):.4g}, not 1",
            source,
            "write w, x, y, z of a unit quaternion, w first",
        )
        return None
    if deviation > SILENT_DEVIATION:
        builder.warning(
            f"the quaternion has length {math.hypot(w, x, y, z):.6g}, not 1; mended",
            source,
            "write it with more digits, or look for a slip in one of them",
        )
    return so3.normalized((w, x, y, z))
