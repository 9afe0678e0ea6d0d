"""What can be set in raw mode, with the unit of each number and where its default comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from modelserver.estimation.settings import FixSettings


@dataclass(frozen=True, slots=True)
class RawSettings(FixSettings):
    """Settings of raw mode. SI units and radians; a sigma is one standard deviation.

    Defaults are a data sheet's or physics' numbers, named at each; none is tuned to a recording.
    Raises ValueError for a number that is not finite or outside its range.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    # --- how fixes err relative to each other ---

    fix_noise_share: float = 0.5
    """The part of a fix's sigma that is new with each fix. The rest (orbit, clock, air, slow multipath) is
    shared by neighbouring fixes and falls out of differences; receiver noise is the smaller part of the range
    error budget (Kaplan and Hegarty, Understanding GPS, error budgets), so half is on the safe side."""
    fix_correlation_time: float = 10.0
    """Correlation time of that rest, seconds. A standing antenna's multipath turns with the satellites, in
    minutes; a moving one's changes with every few metres, in seconds: the course is drawn while moving."""

    # --- what the vehicle can do ---

    maximum_speed: float = 30.0
    """Fastest the vehicle moves, m/s. A fix farther away than this allows is a jump."""
    maximum_acceleration: float = 4.0
    """Hardest change of speed or direction, m/s2: tyre grip of about 0.4 on loose ground."""
    usual_acceleration: float = 0.5
    """Sigma of the speed's change that is not foreseen, m/s2: an unmanned ground vehicle's ordinary driving."""
    jump_sigmas: float = 5.0
    """How many sigmas a fix may be off its prediction before it is a jump."""
    jump_fixes: int = 5
    """How many refused fixes in a row, agreeing among themselves, are believed instead of the prediction."""
    jump_time: float = 5.0
    """How long they must have agreed, seconds: multipath on a moving vehicle changes within a few seconds."""

    # --- the inertial unit ---

    gyro_noise: float = 1e-3
    """Angle random walk, rad/sqrt(s): MicroStrain 3DM-GX1 data sheet, 3.5 deg/sqrt(hour)."""
    gyro_bias_sigma: float = 0.012
    """Bias before it was captured, rad/s: 3DM-GX1 data sheet, 0.7 deg/s over temperature."""
    gyro_bias_walk: float = 3.5e-5
    """Random walk of the bias, rad/s/sqrt(s): the data sheet's 0.02 deg/s short-term, reached in 100 s."""
    tilt_sigma: float = 0.035
    """Sigma of roll and pitch, rad: 3DM-GX1 data sheet, 2 deg under dynamic conditions."""
    tilt_time: float = 5.0
    """Time constant with which specific force corrects roll and pitch, seconds: long against a corner, short
    against what gyro bias does (0.012 rad/s would tilt by 0.06 rad)."""
    maximum_tilt: float = 1.05
    """Tilt from which the pose is not valid, rad: 60 deg, steeper than any ground vehicle stands. A unit that is
    mounted otherwise than the geometry says shows up here."""
    tilt_gate: float = 1.0
    """Largest | |f| - g |, m/s2, at which specific force is taken for gravity: a tenth of g."""
    rate_hold: float = 0.2
    """Longest gap between inertial samples that is bridged with the last rate, seconds; then the turn stops."""
    gap_rate_sigma: float = 0.3
    """Sigma of the yaw rate that nobody measured during a gap, rad/s: a vehicle in a gentle turn."""

    # --- heading ---

    course_speed: float = 0.5
    """Least speed at which the receiver's course is taken for heading, m/s."""
    velocity_sigma: float = 0.1
    """Sigma of the receiver's velocity where it tells none, m/s: three times the 0.03 m/s rms of the OEM4 sheet."""
    course_sigma_limit: float = 0.15
    """A course is taken when its sigma is below this, rad; from positions it is waited for until it is."""
    course_window: float = 30.0
    """Longest stretch of fixes that one course is drawn from, seconds."""
    course_turn_share: float = 0.1
    """Added to a course's sigma for each radian turned within the stretch: speed is not constant in a turn."""
    course_gate: float = 4.0
    """How many sigmas a course may be off the carried heading before it is refused."""
    course_rejections: int = 5
    """How many courses in a row are refused before heading is taken up anew from them."""
    heading_floor: float = 0.01
    """Heading's sigma never falls below this, rad: side slip and the mount's yaw do not average out."""

    # --- speed and standing ---

    speed_window: float = 5.0
    """Longest stretch of fixes that the speed is drawn from, seconds."""
    stationary_speed: float = 0.15
    """Below this speed the vehicle may be standing, m/s."""
    stationary_rate: float = 0.01
    """Yaw rate's spread and its distance from the bias below which the gyro is quiet, rad/s: 0.6 deg/s."""
    stationary_time: float = 2.0
    """How long both must last before the vehicle is taken to stand and the bias is captured, seconds."""

    # --- time and validity ---

    gps_timeout: float = 2.0
    """Age of the last good fix past which a pose is stale, seconds: four missed fixes of a 2 Hz receiver."""
    imu_timeout: float = 0.5
    """Age of the last inertial sample past which a pose is stale, seconds."""
    fix_rejections: int = 2
    """How many refused fixes in a row make a pose invalid: one is an outlier."""
    risk: float = 1e-3
    """Probability that the true position, or heading, is outside its bound."""
    horizontal_limit: float = 20.0
    """Horizontal bound past which a pose is invalid, metres."""
    heading_limit: float = 0.6
    """Heading bound past which a pose is invalid, radians."""

    def __post_init__(self) -> None:
        FixSettings.__post_init__(self)
        for name in ("risk", "fix_noise_share"):
            if getattr(self, name) > 1.0:
                raise ValueError(f"{name} is at most 1, got {getattr(self, name)}")
        if self.maximum_tilt > math.pi / 2:
            raise ValueError(f"maximum_tilt is at most pi/2, got {self.maximum_tilt}")
        if self.risk > 0.5:
            raise ValueError(f"risk is at most 0.5, got {self.risk}")
