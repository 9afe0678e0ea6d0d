"""Settings of raw mode, each with its unit and the source of its default."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from modelserver.estimation.filter.settings import SharedSettings


@dataclass(frozen=True, slots=True)
class RawSettings(SharedSettings):
    """Settings of raw mode. SI units and radians; a sigma is one standard deviation.

    Defaults are from data sheets or physics, as stated at each; none is tuned to a recording. Raises ValueError for a
    number that is not finite or out of range.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    # --- errors of fixes relative to each other ---

    fix_noise_share: float = 0.5
    """Share of the sigma of a fix that is new with each fix. The rest (orbit, clock, atmosphere, slow multipath) is
    common to neighboring fixes and cancels in differences; receiver noise is the smaller part of the range error budget
    (Kaplan and Hegarty, Understanding GPS, error budgets), so half is conservative."""
    fix_correlation_time: float = 10.0
    """Correlation time of that rest, seconds. Multipath of a stationary antenna changes with the satellites, in
    minutes; of a moving one with every few meters, in seconds: a course is measured while moving."""

    # --- vehicle ---

    maximum_speed: float = 30.0
    """Largest speed of the vehicle, m/s. A receiver velocity twice as large is not used."""
    usual_acceleration: float = 0.5
    """Sigma of the unpredicted change of speed, m/s2: ordinary driving of an unmanned ground vehicle."""

    # --- IMU ---

    tilt_sigma: float = 0.035
    """Sigma of roll and pitch, rad: 3DM-GX1 data sheet, 2 deg under dynamic conditions."""
    tilt_time: float = 5.0
    """Time constant with which specific force corrects roll and pitch, seconds: long against a curve, short against
    the effect of gyro bias (0.012 rad/s would tilt by 0.06 rad)."""
    tilt_gate: float = 1.0
    """Largest | |f| - g |, m/s2, at which specific force is used as gravity: a tenth of g."""

    # --- heading ---

    course_speed: float = 0.5
    """Least speed at which the course of the receiver is used for the heading, m/s."""
    course_sigma_limit: float = 0.15
    """Sigma below which a course is used, rad; a course from positions waits until it is."""
    course_window: float = 30.0
    """Longest time between the two fixes of a course, seconds."""
    course_turn_share: float = 0.1
    """Added to the sigma of a course for each radian turned between its fixes: speed is not constant in a turn."""
    course_gate: float = 4.0
    """Number of sigmas by which a course may differ from the predicted heading before it is rejected."""
    course_rejections: int = 5
    """Number of rejected courses in a row after which they reset the heading."""
    heading_floor: float = 0.01
    """Least sigma of the heading, rad: side slip and the yaw of the mount do not average out."""

    # --- speed, stationary detection ---

    speed_window: float = 5.0
    """Longest time between the two fixes of a speed, seconds."""
    stationary_speed: float = 0.15
    """Speed below which the vehicle may be stationary, m/s."""
    stationary_rate: float = 0.01
    """Spread of the gyros, and distance of the rate from the bias, below which they are quiet, rad/s: 0.6 deg/s."""
    stationary_time: float = 2.0
    """Time for which both must last before the vehicle is stationary and the bias is measured, seconds."""

    # --- time and validity ---

    gps_timeout: float = 2.0
    """Age of the last good fix above which a pose is stale, seconds: four missed fixes of a 2 Hz receiver."""
    fix_rejections: int = 2
    """Number of rejected fixes in a row that make a pose invalid: one is an outlier."""
    risk: float = 1e-3
    """Probability that the error of position, or of heading, exceeds its protection level."""
    horizontal_limit: float = 20.0
    """Position error that a pose may have, meters: it is valid while a larger one is less probable than 0.01."""
    heading_limit: float = 0.6
    """The same of the heading error, radians."""

    def __post_init__(self) -> None:
        SharedSettings.__post_init__(self)
        for name, most in (("fix_noise_share", 1.0), ("maximum_tilt", math.pi / 2), ("risk", 0.5)):
            if getattr(self, name) > most:
                raise ValueError(f"{name} is at most {most:.4g}, got {getattr(self, name)}")
