"""Settings common to all modes of localization: quality of fixes, origin, clocks."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class FixSettings:
    """Quality limits of fixes, origin capture, clock jumps. SI units; a sigma is one standard deviation.

    Defaults are from data sheets or physics, as stated at each; none is tuned to a recording. Raises ValueError for a
    number that is not finite or out of range.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    # --- which fixes are good enough ---

    minimum_fix_type: int = 1
    """Least fix type used: 1 any, 2 three-dimensional, 3 differential, 4 RTK float, 5 RTK fixed."""
    minimum_satellites: int = 4
    """Least satellites in the solution, where the receiver reports them: four unknowns need four (IS-GPS-200)."""
    maximum_hdop: float = 8.0
    """Largest horizontal dilution of precision, where the receiver reports it. It multiplies every range error."""
    maximum_sigma: float = 20.0
    """Largest horizontal sigma of a fix, meters: ten times that of an ordinary receiver."""
    uere: float = 3.0
    """Range error of a fix without corrections, meters for an HDOP of 1: 8 m at 95 % horizontally, the worst that the
    GPS Standard Positioning Service Performance Standard (2020) allows as global average.
    """
    uere_differential: float = 0.5
    """The same with code corrections (SBAS or DGPS), meters: sub-meter class of receiver data sheets."""
    uere_rtk_float: float = 0.2
    """The same with carrier corrections, ambiguities floating, meters: NovAtel OEM4 data sheet, RT-20, 0.2 m."""
    uere_rtk_fixed: float = 0.02
    """The same with ambiguities fixed, meters: 2 to 5 cm in the 2005 report (5.1)."""
    assumed_hdop: float = 1.5
    """HDOP assumed where the receiver reports neither it nor a covariance: a common value under open sky."""
    assumed_height_sigma: float = 100.0
    """Sigma of the height where no fix gave one but the origin has one, or one is above mean sea level without
    undulation, meters: undulation is -107 to 86 m (EGM2008).
    """
    unknown_height_sigma: float = 5000.0
    """Sigma of height 0 where the height is unknown, meters: roads reach above 5000 m."""

    # --- origin ---

    origin_fixes: int = 5
    """Number of successive good fixes that are averaged to set the origin, where none is configured."""
    origin_scatter: float = 3.0
    """Largest scatter of those fixes about a straight drive, in sigmas of a fix."""

    # --- clocks ---

    clock_jump: float = 10.0
    """A stamp farther ahead of its source's last one than this, seconds, must be confirmed by further samples."""
    clock_jump_samples: int = 3
    """Number of successive samples that confirm a step of a source's clock."""

    def __post_init__(self) -> None:
        problems = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, bool | None) and (not math.isfinite(value) or value <= 0):
                problems.append(f"{field.name} must be finite and above 0, got {value}")
        if self.minimum_fix_type > 5:
            problems.append(f"minimum_fix_type is 1 to 5, got {self.minimum_fix_type}")
        if self.origin_fixes > 1000:
            problems.append(f"origin_fixes is at most 1000, got {self.origin_fixes}")
        if problems:
            raise ValueError("\n".join(problems))
