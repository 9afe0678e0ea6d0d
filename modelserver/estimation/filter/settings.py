"""Settings of fixes in all modes, and of the filter (noise, gates), with units and sources of the defaults."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class SharedSettings:
    """Settings that raw mode and the filter share. SI units and radians; a sigma is one standard deviation.

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

    # --- the inertial unit, the receiver's velocity, tilt ---

    gyro_noise: float = 1e-3
    """Angle random walk, rad/sqrt(s): MicroStrain 3DM-GX1 data sheet, 3.5 deg/sqrt(hour)."""
    gyro_bias_sigma: float = 0.012
    """Bias before it was captured, rad/s: 3DM-GX1 data sheet, 0.7 deg/s over temperature."""
    gyro_bias_walk: float = 3.5e-5
    """Random walk of the bias, rad/s/sqrt(s): the data sheet's 0.02 deg/s short-term, reached in 100 s."""
    rate_hold: float = 0.2
    """Longest gap between inertial samples that is bridged with the last one, seconds."""
    gap_rate_sigma: float = 0.3
    """Sigma of the turn rate that nobody measured during a gap, rad/s: a vehicle in a gentle turn."""
    stationary_rate: float = 0.02
    """Spread of the gyros, rad/s, below which they are quiet: the unit's own noise in a bandwidth of 50 Hz is 0.007
    (3DM-GX1 data sheet), and an engine idles."""
    stationary_force: float = 0.15
    """Spread of the specific force, m/s2, below which the accelerometers are quiet: an idling engine."""
    velocity_sigma: float = 0.1
    """Sigma of the receiver's velocity if it reports none, m/s: three times the 0.03 m/s rms of the OEM4 sheet."""
    imu_timeout: float = 0.5
    """Age of the last inertial sample past which a pose is stale, seconds."""
    maximum_tilt: float = 1.05
    """Tilt from which the pose is not valid, rad: 60 deg, steeper than any ground vehicle stands."""

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


@dataclass(frozen=True, slots=True)
class FilterSettings(SharedSettings):
    """Settings of the filter. SI units and radians; a sigma is one standard deviation.

    Defaults are a data sheet's or physics' numbers, named at each; none is tuned to a recording.
    Raises ValueError for a number that is not finite or outside its range.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    # --- the inertial unit ---

    gyro_bias_step: float = 0.02
    """Change of a gyro's bias that a fault brings, two standard deviations, rad/s: 1 deg/s, as after a shock or with a
    failing supply. The heading's protection level covers it until fixes show it."""
    lever_arm_sigma: float = 0.1
    """Error of the antenna's place on the vehicle, m, in the protection level: measured with a tape."""
    gyro_scale_sigma: float = 0.01
    """Error of the scale of the gyros: typical of an uncalibrated MEMS unit."""
    accelerometer_noise: float = 0.02
    """Velocity random walk on the moving vehicle, m/s/sqrt(s): the unit's own 0.4 mg/sqrt(Hz) (3DM-GX1 data sheet) and
    what shaking adds that sampling does not average: 0.1 m/s2 within a bandwidth of 25 Hz."""
    accelerometer_bias_sigma: float = 0.1
    """Bias before it was found, m/s2: 3DM-GX1 data sheet, 10 mg; an error of the mount's tilt looks the same."""
    accelerometer_bias_walk: float = 1e-3
    """Random walk of the bias, m/s2/sqrt(s): 3 mg in 15 minutes of warming up."""
    gap_acceleration: float = 1.0
    """Sigma of the acceleration that nobody measured during a gap, m/s2: ordinary driving and braking."""
    wheel_rate_sigma: float = 0.05
    """Sigma of the turn rate by the wheels without a gyro, rad/s: one side slips 2 % at 2 m/s, 1 m apart."""
    frozen_time: float = 1.0
    """A unit that repeats one value for so long is frozen, seconds: noise alone changes the last digit of every
    sample."""

    # --- start-up ---

    leveling_time: float = 2.0
    """How long a standing vehicle's specific force and rates are averaged for tilt and biases, seconds (report 5.1)."""
    leveling_timeout: float = 5.0
    """After how long a vehicle that is not stationary is leveled on the move, seconds."""
    leveling_acceleration: float = 1.0
    """Sigma of the mean acceleration while leveling on the move, m/s2: a tenth of g is a tilt of 0.1 rad."""
    tilt_mount_limit: float = 0.6
    """Largest angle between the felt vertical and the geometry's up, at rest, rad: no vehicle starts on a slope of 35
    degrees, but a wrong mount is off by 90."""

    # --- wheels and how the vehicle moves over ground ---

    wheel_sigma: float = 0.02
    """Sigma of a wheel's speed if the sample has none, m/s: a pulse of 1 cm twice in a second."""
    wheel_period: float = 0.4
    """Shortest time over which the wheels' way is compared, seconds: an encoder's errors of place, a pulse or an update
    missed, fall out over a longer way, and the inertial unit bridges the time."""
    wheel_scale_sigma: float = 0.03
    """Sigma of the common error of scale of the wheels: tyre pressure and load change a rolling radius by 3 %."""
    wheel_scale_walk: float = 1e-4
    """Random walk of the scale, 1/sqrt(s): 0.6 % in an hour, as tyres warm up and ground changes."""
    wheel_yaw_sigma: float = 0.01
    """Sigma of the angle between the way that the wheels roll and the geometry's x axis, rad: surveying a mount."""
    wheel_yaw_walk: float = 1e-5
    """Random walk of that angle, rad/sqrt(s): load shifts it."""
    steering_sigma: float = 0.3
    """Sigma of the angle of a wheel that steers where nothing measures it, rad: half of the 35 degrees that road
    vehicles steer at most (turning circle of 10 m, wheelbase of 2.7 m)."""
    slip_ratio: float = 0.01
    """Slip of a driven wheel on firm ground, share of speed (M. Mitschke, Dynamik der Kraftfahrzeuge: 1 to 2 %)."""
    slip_acceleration: float = 0.01
    """Slip that an acceleration of 1 m/s2 adds, as a share of speed: tyre stiffness of about 10 per unit of slip."""
    slip_turn: float = 0.1
    """Slip of a skid-steered vehicle's mean wheel speed, as a share of its sides' speed in the turn."""
    slip_time: float = 1.0
    """How long a slip lasts, seconds: samples within this time err together."""
    side_sigma: float = 0.02
    """Sigma of the sideways speed of the rolling frame straight ahead, m/s."""
    side_slip: float = 0.006
    """Side slip angle that a sideways acceleration of 1 m/s2 brings, rad: cornering stiffness of an ordinary tyre."""
    roll_point_sigma: float = 0.05
    """How far the point that moves straight ahead moves along the vehicle, meters: load, and ground under a skid."""
    up_sigma: float = 0.05
    """Sigma of the speed along the vehicle's up, m/s: springs and bumps."""
    up_share: float = 0.01
    """The same as a share of speed: what pitching on its springs turns of the way ahead, 0.6 deg."""

    # --- standing ---

    stationary_speed: float = 0.05
    """Speed below which wheels and filter may be standing, m/s."""
    stationary_time: float = 1.0
    """How long all must last before the vehicle is taken to stand, seconds."""
    stationary_sigma: float = 0.01
    """Sigma of the speed of a standing vehicle, m/s: it rocks."""
    recapture_time: float = 3.0
    """How long the vehicle must be stationary before the gyro biases are calibrated again, seconds (report 5.1)."""

    # --- fixes ---

    gps_white_share: float = 0.15
    """The part of a fix's sigma that is new with each fix. The rest (orbit, clock, air, multipath) wanders: receiver
    noise is the smallest part of the range error budget (Kaplan and Hegarty, Understanding GPS, error budgets)."""
    gps_correlation_time: float = 60.0
    """Correlation time of the rest, seconds: multipath of a slow antenna lasts minutes (Kaplan and Hegarty)."""
    gps_latency_sigma: float = 0.05
    """Sigma of how late a fix's place is, seconds, beyond what is configured: receivers compute for 20 to 150 ms and
    stamp as they please (P. Groves 2013, 10.3). It is estimated: at 20 m/s 80 ms are worse than all else."""
    gps_sigma_floor: float = 0.02
    """Least sigma of a fix, meters: RTK, 2 cm (OEM4 data sheet)."""
    gps_inflation_time: float = 2.0
    """Time constant, seconds, with which the wandering of fixes is learnt from what they do beside odometry."""
    gps_inflation_limit: float = 100.0
    """Largest inflation of the process noise of the time-correlated error, in variance, before fixes are rejected."""
    position_slew_rate: float = 2.0
    """How fast the pose follows the time-correlated error of the fixes, m/s, at most: the pose in the world is where
    the receiver would report it, because way points are surveyed with it, but it does not jump there."""
    course_speed: float = 1.0
    """Least speed at which course and speed are taken for a velocity, m/s (report 5.1)."""
    course_sigma: float = 0.05
    """Sigma of a course if the receiver reports none, rad: 0.1 m/s sideways at 2 m/s."""
    gate_risk: float = 1e-4
    """Probability that a good measurement is refused by its chi-square gate."""

    # --- other sources ---

    use_magnetometer: bool = False
    """Whether magnetic headings are used (magnetometer mode) or not (vertical-gyro mode); report 5.1: the vehicle's own
    iron disturbs them."""
    magnetic_sigma: float = 0.1
    """Sigma of a calibrated magnetic heading, rad: 3DM-GX1 data sheet, 2 deg, and the vehicle's changing fields."""
    magnetic_time: float = 10.0
    """How long a magnetic disturbance lasts, seconds: the vehicle drives past iron."""
    magnetic_strength: float = 0.15
    """Largest deviation of the field's strength from the world magnetic model's, as a share, beyond which it is
    disturbed."""
    orientation_sigma: float = 0.035
    """Sigma of the unit's own roll, pitch and yaw, rad: 3DM-GX1 data sheet, 2 deg under dynamic conditions."""
    orientation_time: float = 5.0
    """How long errors of the unit's own orientation last, seconds: its own filter's time constant."""
    aiding_sigma: float = 0.5
    """Sigma of another source's position or range if it reports none, meters."""
    aiding_rotation_sigma: float = 0.1
    """Sigma of another source's orientation if it reports none, rad."""

    # --- heading ---

    align_sigma: float = 0.12
    """Largest sigma of a heading, rad, that is accepted from fixes along the path driven."""
    align_window: float = 60.0
    """Longest stretch of fixes that heading is found from, seconds."""
    align_speed: float = 1.0
    """Least speed at which the receiver's velocity gives the heading, m/s."""
    reverse_speed: float = 10.0
    """Speed from which on the vehicle is known to drive forward, m/s, if neither wheels nor accelerations show it: the
    reverse gear of a road vehicle ends at about 20 km/h, and electric ones are limited to little more. For a vehicle
    that drives as fast either way set it to `maximum_speed`."""

    # --- losing and finding fixes ---

    recovery_fixes: int = 10
    """How many refused fixes, that agree with the path driven, before the position is reset to them."""
    recovery_time: float = 20.0
    """How long they must have agreed, seconds: a reflection seldom lasts through 20 s of driving."""
    recovery_distance: float = 5.0
    """How far the vehicle must have moved meanwhile, meters: at rest a wrong fix agrees as well as a right one."""
    jump_epoch: float = 1.0
    """A single correction that moves the pose by more, meters, starts a new epoch: a discontinuity for its users."""

    # --- time ---

    horizon: float = 1.0
    """How late a measurement may come and still be fused at its instant, seconds."""
    replay_budget: int = 128
    """Most measurements and inertial samples fused again for a delayed one; more wait for the next sample."""

    # --- validity ---

    gps_timeout: float = 300.0
    """Age of the last used fix past which a pose is stale, seconds: the bounds speak long before."""
    risk_per_hour: float = 1e-5
    """Probability in an hour that the true position, or heading, is outside its bound."""
    horizontal_limit: float | None = None
    """Position error that a pose may have, meters: it is valid while a larger one has a probability of less than 0.01.
    If not given it is by the receiver's class: 10 m with carrier corrections, 20 m with code corrections, else 36 m."""
    heading_limit: float | None = None
    """The same of the heading error, radians. If not given 0.6; while no wheels measure the speed 0.35, since nothing
    shows then that the vehicle moves along its own axis, as the heading by fixes assumes."""
    maximum_speed: float = 60.0
    """Fastest the vehicle moves, m/s: a state beyond is taken for a diverged filter."""

    def __post_init__(self) -> None:
        problems = []
        try:
            SharedSettings.__post_init__(self)
        except ValueError as error:
            problems += str(error).splitlines()
        for name, most in (("gps_white_share", 1.0), ("gate_risk", 0.1), ("risk_per_hour", 0.1), ("horizon", 10.0)):
            if math.inf > getattr(self, name) > most:
                problems.append(f"{name} is at most {most:g}, got {getattr(self, name)}")
        for name, most, words in (("maximum_tilt", 1.5708, "pi/2"), ("heading_limit", 3.1416, "pi")):
            value = getattr(self, name)
            if value is not None and math.inf > value > most:
                hint = f"; {value:g} degrees are {math.radians(value):.3g}"
                problems.append(f"{name} is at most {words} radians, got {value}{hint}")
        if not 8 <= self.replay_budget <= 4096 and self.replay_budget > 0:
            problems.append(f"replay_budget is between 8 and 4096, got {self.replay_budget}")
        if problems:
            raise ValueError("\n".join(problems))
