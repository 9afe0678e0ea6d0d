"""What can be set in raw mode, with the unit of each number and where its default comes from."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class RawSettings:
    """Settings of raw mode. SI units and radians; a sigma is one standard deviation.

    Defaults are a data sheet's or physics' numbers, named at each; none is tuned to a recording.
    Raises ValueError for a number that is not finite or outside its range.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    # --- which fixes are good enough ---

    minimum_fix_type: int = 1
    """Least fix type taken: 1 any, 2 three-dimensional, 3 differential, 4 RTK float, 5 RTK fixed."""
    minimum_satellites: int = 4
    """Least satellites in the solution, where the receiver tells: four unknowns need four (IS-GPS-200)."""
    maximum_hdop: float = 8.0
    """Largest horizontal dilution, where the receiver tells. Above it the geometry multiplies every error."""
    maximum_sigma: float = 20.0
    """Largest horizontal sigma of a fix, metres: ten times an ordinary receiver's."""
    uere: float = 3.0
    """Range error of a fix without corrections, metres for an HDOP of 1: 8 m at 95 % horizontally, the worst
    that the GPS Standard Positioning Service Performance Standard (2020) allows as global average."""
    uere_differential: float = 0.5
    """The same with code corrections (SBAS or DGPS), metres: sub-metre class of receiver data sheets."""
    uere_rtk_float: float = 0.2
    """The same with carrier corrections, ambiguities floating, metres: NovAtel OEM4 data sheet, RT-20, 0.2 m."""
    uere_rtk_fixed: float = 0.02
    """The same with ambiguities fixed, metres: 2 to 5 cm in the 2005 report (5.1)."""
    assumed_hdop: float = 1.5
    """HDOP taken where the receiver tells neither it nor a covariance: a common value under open sky."""
    assumed_height_sigma: float = 100.0
    """Sigma of the height where no fix gave one but the origin has one, or one is above mean sea level without
    undulation, metres: undulation is -107 to 86 m (EGM2008)."""
    unknown_height_sigma: float = 5000.0
    """Sigma of height 0 where nothing tells a height, metres: roads reach above 5000 m."""

    # --- how fixes err relative to each other ---

    fix_noise_share: float = 0.5
    """The part of a fix's sigma that is new with each fix. The rest (orbit, clock, air, slow multipath) is
    shared by neighbouring fixes and falls out of differences; receiver noise is the smaller part of the range
    error budget (Kaplan and Hegarty, Understanding GPS, error budgets), so half is on the safe side."""
    fix_error_time: float = 10.0
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
    course_refusals: int = 5
    """How many courses in a row are refused before heading is taken up anew from them."""
    heading_floor: float = 0.01
    """Heading's sigma never falls below this, rad: side slip and the mount's yaw do not average out."""

    # --- speed and standing ---

    speed_window: float = 5.0
    """Longest stretch of fixes that the speed is drawn from, seconds."""
    standing_speed: float = 0.15
    """Below this speed the vehicle may be standing, m/s."""
    standing_rate: float = 0.01
    """Yaw rate's spread and its distance from the bias below which the gyro is quiet, rad/s: 0.6 deg/s."""
    standing_time: float = 2.0
    """How long both must last before the vehicle is taken to stand and the bias is captured, seconds."""

    # --- origin ---

    origin_fixes: int = 5
    """How many good fixes in a row are averaged to set the origin, where none is configured."""
    origin_scatter: float = 3.0
    """Largest scatter of those fixes about a straight drive, in sigmas of a fix."""

    # --- time and validity ---

    gps_timeout: float = 2.0
    """Age of the last good fix past which a pose is stale, seconds: four missed fixes of a 2 Hz receiver."""
    imu_timeout: float = 0.5
    """Age of the last inertial sample past which a pose is stale, seconds."""
    clock_ahead: float = 10.0
    """A stamp farther ahead of its source's last one than this, seconds, must be confirmed."""
    clock_samples: int = 3
    """How many samples in a row confirm that a clock was set."""
    refusals: int = 2
    """How many refused fixes in a row make a pose invalid: one is an outlier."""
    risk: float = 1e-3
    """Probability that the true position, or heading, is outside its bound."""
    horizontal_limit: float = 20.0
    """Horizontal bound past which a pose is invalid, metres."""
    heading_limit: float = 0.6
    """Heading bound past which a pose is invalid, radians."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value) or value <= 0:
                raise ValueError(f"{field.name} must be finite and above 0, got {value}")
        if not 1 <= self.minimum_fix_type <= 5:
            raise ValueError(f"minimum_fix_type is 1 to 5, got {self.minimum_fix_type}")
        for name in ("risk", "fix_noise_share"):
            if getattr(self, name) > 1.0:
                raise ValueError(f"{name} is at most 1, got {getattr(self, name)}")
        if self.maximum_tilt > math.pi / 2:
            raise ValueError(f"maximum_tilt is at most pi/2, got {self.maximum_tilt}")
        if self.risk > 0.5:
            raise ValueError(f"risk is at most 0.5, got {self.risk}")
        if self.origin_fixes > 1000:
            raise ValueError(f"origin_fixes is at most 1000, got {self.origin_fixes}")
