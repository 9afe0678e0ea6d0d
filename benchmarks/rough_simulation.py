"""Simulated drives on uneven ground, with side slip and aiding sensors, for tests and benchmarks.

Vehicle motion on uneven ground with side slip, in closed form with exact derivatives.

State: position, velocity and acceleration of the rolling frame, attitude with angular rate and acceleration.
Ground: a plane plus sine waves, z(x, y). Along the path each wave is a function of its phase u(t), so height and slopes
and their time rates follow from the chain rule. Attitude (`_Slope`): fixed-axis angles yaw, pitch = -atan q and
roll = atan(p / sqrt(1 + q^2)) with the slopes q along the heading and p to the left; the vehicle's z is the ground's
normal.
Side slip: the slip angle b = course - yaw is a cornering compliance times lateral acceleration plus a sum of sines. It
yaws the vehicle relative to the path instead of moving the path, so nothing is integrated.
Assumptions: one point of contact (the rolling frame); the path in the plan is the trajectory's whatever the slope.
Limits: waves shorter than a few wheelbases are steeper for this vehicle than for a real one.
Read top-down: `make_motion` -> `GroundMotion.at` -> `SlipAngle.at`, `Terrain.evaluate`, `_Slope`.

`RoughSimulation` is the product's `Simulation` with these options. Aiding sensors (absolute poses, visual odometry,
ranges) are true up to the noise that they state. `EncoderModel` and `TriadModel` are faults of the product's sensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

from modelserver.geometry.model import Model
from modelserver.messages import AbsolutePoseSample, Direction, Origin, RangeSample, RelativePoseSample, WheelSample
from modelserver.simulation import Event, GpsModel, ImuModel, Simulation
from modelserver.simulation.sensors import (
    Encoder,
    GaussMarkov,
    Intervals,
    NoiseSource,
    Run,
    Timing,
    WheelsModel,
    apply_rows,
    is_within,
)
from modelserver.simulation.trajectory import Attitude, Coefficients, MotionModel, Trajectory, TrajectoryMotion
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3

# --- ground and side slip -----------------------------------------------------------------------------------


def compute_higher_rates(trajectory: Trajectory, t: float) -> Vector3:
    """Return first and second rate of curvature (1/m/s, 1/m/s2) and jerk (m/s3, second rate of speed)."""
    piece, u = trajectory._locate(t)
    curvature, speed = piece.curvature_rate, piece.speed_rate
    rates = (curvature, _derive(curvature, piece.duration), _derive(speed, piece.duration))
    return so3.to_vector3(sum(c * u**n for n, c in enumerate(rate)) for rate in rates)


@lru_cache(maxsize=4096)
def _derive(coefficients: Coefficients, duration: float) -> Coefficients:
    return tuple(n * each / duration for n, each in enumerate(coefficients))[1:]


@dataclass(frozen=True, slots=True)
class SideSlip:
    """Lateral sliding of a vehicle, which its wheels do not measure.

    Attributes
    ----------
    cornering : slip angle per lateral acceleration, rad/(m/s2); the vehicle slides out of the turn
    random_sigma : root mean square of a random lateral speed, m/s: `count` sines of random phase
    periods : shortest and longest period of the sines, s; drawn evenly in their logarithm
    fade_speed : the random part is scaled by v^2 / (v^2 + fade_speed^2), m/s: a stationary vehicle does not slide
    """

    cornering: float = 0.0
    random_sigma: float = 0.0
    periods: tuple[float, float] = (3.0, 30.0)
    count: int = 5
    fade_speed: float = 0.5

    def __post_init__(self) -> None:
        if not (0 < self.periods[0] <= self.periods[1] and self.count >= 1 and self.fade_speed > 0):
            raise ValueError(f"periods and fade_speed must be positive, and count at least 1; got {self}")


class SlipAngle:
    """Slip angle of one run: course minus yaw (of the direction of forward speed), with its rates."""

    __slots__ = ("_cornering", "_fade", "_sines")

    def __init__(self, model: SideSlip, seed: int):
        noise = NoiseSource(seed, "side slip").generator
        amplitude = model.random_sigma * math.sqrt(2.0 / model.count)
        shortest, longest = map(math.log, model.periods)
        self._cornering = model.cornering
        self._fade = model.fade_speed**2
        self._sines = [
            (amplitude, math.tau / math.exp(noise.uniform(shortest, longest)), noise.uniform(-math.pi, math.pi))
            for _ in range(model.count if amplitude else 0)
        ]

    def at(self, t: float, motion: TrajectoryMotion, higher: Vector3) -> Vector3:
        """Return the slip angle at `t` seconds and its first and second rate, rad, rad/s, rad/s2.

        `motion` is the trajectory's at `t`, and `higher` the result of `compute_higher_rates`.
        """
        v, v1, v2 = motion.speed, motion.forward_acceleration, higher[2]
        size, sign = abs(v), math.copysign(1.0, v)
        k, k1, k2 = motion.curvature, higher[0], higher[1]
        # tires slip against the lateral acceleration k v^2, forward and in reverse
        c = -self._cornering
        angle = c * k * v * size
        rate = c * (k1 * v * size + 2.0 * k * size * v1)
        acceleration = c * (k2 * v * size + 4.0 * k1 * size * v1 + 2.0 * k * (sign * v1 * v1 + size * v2))
        if self._sines:
            w = w1 = w2 = 0.0
            for amplitude, omega, phase in self._sines:
                sine, cosine = amplitude * math.sin(omega * t + phase), amplitude * math.cos(omega * t + phase)
                w += sine
                w1 += omega * cosine
                w2 -= omega * omega * sine
            below = v * v + self._fade
            g, gv = v / below, (self._fade - v * v) / (below * below)
            gvv = 2.0 * v * (v * v - 3.0 * self._fade) / (below * below * below)
            g1, g2 = gv * v1, gvv * v1 * v1 + gv * v2
            angle += w * g
            rate += w1 * g + w * g1
            acceleration += w2 * g + 2.0 * w1 * g1 + w * g2
        return (angle, rate, acceleration)


@dataclass(frozen=True, slots=True)
class Wave:
    """A sine wave of the ground: `amplitude` and `length` in meters.

    `direction` is in radians counter-clockwise from east, `phase` in radians at the origin.
    """

    amplitude: float
    length: float
    direction: float = 0.0
    phase: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.amplitude, self.length, self.direction, self.phase)
        if not (all(map(math.isfinite, numbers)) and self.length > 0):
            raise ValueError(f"a wave must have a positive length and finite numbers; got {self}")


class GroundState(NamedTuple):
    """Ground under a moving point: height (m), slope to east and to north, each with its first and second time rate."""

    height: Vector3
    east: Vector3
    north: Vector3


@dataclass(frozen=True, slots=True)
class Terrain:
    """Height of the ground above the tangent plane: z = slope_east x + slope_north y + sum of the waves."""

    slope_east: float = 0.0
    slope_north: float = 0.0
    waves: tuple[Wave, ...] = ()
    _waves: tuple[tuple[float, float, float, float], ...] = field(init=False, repr=False, compare=False)
    """Amplitude, wave numbers to east and north, phase: computed once for `evaluate`, which is in the inner loop."""

    def __post_init__(self) -> None:
        numbers = [(each, math.tau / each.length, each.direction) for each in self.waves]
        waves = tuple((each.amplitude, k * math.cos(a), k * math.sin(a), each.phase) for each, k, a in numbers)
        object.__setattr__(self, "_waves", waves)

    @classmethod
    def hills(
        cls, seed: int, steepness: float = 0.05, count: int = 4, lengths: tuple[float, float] = (20.0, 120.0)
    ) -> Terrain:
        """Return waves of random direction, phase and length whose slope has the root mean square `steepness`."""
        noise = NoiseSource(seed, "terrain").generator
        waves = []
        for _ in range(count):
            length = math.exp(noise.uniform(math.log(lengths[0]), math.log(lengths[1])))
            amplitude = steepness * math.sqrt(2.0 / count) * length / math.tau
            waves.append(Wave(amplitude, length, noise.uniform(-math.pi, math.pi), noise.uniform(-math.pi, math.pi)))
        return cls(waves=tuple(waves))

    def height(self, east: float, north: float) -> float:
        """Return the ground's height at a position, all in meters."""
        return self.evaluate((east, north, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)).height[0]

    def evaluate(self, position: Vector3, velocity: Vector3, acceleration: Vector3) -> GroundState:
        """Return the ground under a point that moves in the plan; the arguments' vertical components are not used."""
        x, y, _ = position
        vx, vy, _ = velocity
        ax, ay, _ = acceleration
        se, sn = self.slope_east, self.slope_north
        z0, z1, z2 = se * x + sn * y, se * vx + sn * vy, se * ax + sn * ay
        e0, e1, e2, n0, n1, n2 = se, 0.0, 0.0, sn, 0.0, 0.0
        for amplitude, ke, kn, phase in self._waves:
            # along the path a wave is a function of its phase u(t): chain rule
            u = ke * x + kn * y + phase
            u1, u2 = ke * vx + kn * vy, ke * ax + kn * ay
            sine, cosine = amplitude * math.sin(u), amplitude * math.cos(u)
            first, second = cosine * u1, cosine * u2 - sine * u1 * u1
            bend, bend_rate = -sine * u1, -sine * u2 - cosine * u1 * u1
            z0 += sine
            z1 += first
            z2 += second
            e0 += ke * cosine
            e1 += ke * bend
            e2 += ke * bend_rate
            n0 += kn * cosine
            n1 += kn * bend
            n2 += kn * bend_rate
        return GroundState((z0, z1, z2), (e0, e1, e2), (n0, n1, n2))


def make_motion(
    trajectory: Trajectory, terrain: Terrain | None = None, side_slip: SideSlip | None = None, seed: int = 1
) -> MotionModel:
    """Return the motion of a trajectory on the given ground; the trajectory itself for level ground without slip."""
    if terrain is None and side_slip is None:
        return trajectory
    return GroundMotion(trajectory, terrain, side_slip, seed)


class GroundMotion:
    """`MotionModel` of a trajectory on uneven ground, with side slip, or both."""

    __slots__ = ("_slip", "_terrain", "_trajectory")

    def __init__(self, trajectory: Trajectory, terrain: Terrain | None, side_slip: SideSlip | None, seed: int):
        self._trajectory = trajectory
        self._terrain = terrain
        self._slip = None if side_slip is None else SlipAngle(side_slip, seed)

    def at(self, t: float) -> TrajectoryMotion:
        """Return the motion `t` seconds after the start."""
        plan = self._trajectory.at(t)
        yaw, yaw_rate, yaw_acceleration = plan.yaw, plan.yaw_rate, plan.yaw_acceleration
        along, across = plan.speed, 0.0
        if self._slip is not None:
            b, b1, b2 = self._slip.at(t, plan, compute_higher_rates(self._trajectory, t))
            yaw, yaw_rate, yaw_acceleration = yaw - b, yaw_rate - b1, yaw_acceleration - b2
            along, across = plan.speed * math.cos(b), plan.speed * math.sin(b)
        cos, sin = math.cos(yaw), math.sin(yaw)
        ax, ay, _ = plan.acceleration
        push = ax * cos + ay * sin
        motion = plan._replace(
            yaw=yaw,
            yaw_rate=yaw_rate,
            yaw_acceleration=yaw_acceleration,
            speed=along,
            forward_acceleration=push + yaw_rate * across,
            lateral_speed=across,
        )
        if self._terrain is None:
            return motion
        ground = self._terrain.evaluate(plan.position, plan.velocity, plan.acceleration)
        slope = _Slope((yaw, yaw_rate, yaw_acceleration), cos, sin, ground)
        z, vz, az = ground.height
        # forward is (cos, sin, ahead) / length; a distance to the left is longer along the ground than in the plan
        left = across * slope.steepness / slope.length
        return motion._replace(
            position=(*plan.position[:2], z),
            velocity=(*plan.velocity[:2], vz),
            acceleration=(ax, ay, az),
            speed=(along + slope.ahead * vz) / slope.length,
            forward_acceleration=(push + slope.ahead * az) / slope.length + slope.attitude.rate[2] * left,
            lateral_speed=left,
            attitude=slope.attitude,
        )


class _Slope:
    """Slope along and across a heading, and the attitude with rates of a vehicle on it (fixed-axis angles).

    `ahead` is the slope q along the heading, `length` sqrt(1 + q^2), `steepness` sqrt(1 + q^2 + p^2).
    """

    def __init__(self, turn: Vector3, cos: float, sin: float, ground: GroundState):
        yaw, w, w1 = turn
        e, e1, e2 = ground.east
        n, n1, n2 = ground.north
        q, p = e * cos + n * sin, n * cos - e * sin
        f1, g1 = e1 * cos + n1 * sin, n1 * cos - e1 * sin
        q1, p1 = f1 + w * p, g1 - w * q
        q2 = e2 * cos + n2 * sin + w * g1 + w1 * p + w * p1
        p2 = n2 * cos - e2 * sin - w * f1 - w1 * q - w * q1
        # D = sqrt(1 + q^2) and r = p / D, with their rates
        D2 = 1.0 + q * q
        D = math.sqrt(D2)
        D_1 = q * q1 / D
        D_2 = (q1 * q1 + q * q2 - D_1 * D_1) / D
        r = p / D
        r1 = (p1 - r * D_1) / D
        r2 = (p2 - 2.0 * r1 * D_1 - r * D_2) / D
        pitch, pitch1, pitch2 = -math.atan(q), -q1 / D2, (2.0 * q * q1 * q1 / D2 - q2) / D2
        R2 = 1.0 + r * r
        roll, roll1, roll2 = math.atan(r), r1 / R2, (r2 - 2.0 * r * r1 * r1 / R2) / R2
        sp, cp = -q / D, 1.0 / D
        cr = 1.0 / math.sqrt(R2)
        sr = r * cr
        # body rates from the angle rates; their derivatives are the parts of the angular acceleration
        wx, wy, wz = roll1 - w * sp, pitch1 * cr + w * cp * sr, w * cp * cr - pitch1 * sr
        # w cp and its rate
        level1 = w1 * cp - w * sp * pitch1
        self.ahead, self.length, self.steepness = q, D, math.sqrt(D2 + p * p)
        self.attitude = Attitude(
            so3.from_rpy(roll, pitch, yaw),
            (wx, wy, wz),
            (
                roll2 - w1 * sp - w * cp * pitch1,
                pitch2 * cr + level1 * sr + roll1 * wz,
                level1 * cr - pitch2 * sr - roll1 * wy,
            ),
        )


# --- aiding sensors -----------------------------------------------------------------------------------------

ENU = "World:ENU"
UTM = "World:UTM"

_TIMING = Timing(5.0, latency=0.05, jitter=0.005)
_MIN_SIGMA = 1e-4
"""Smallest standard deviation that a source states, meters or radians."""


@dataclass(frozen=True, slots=True)
class AbsolutePoseModel:
    """A source of poses in a world frame, such as map matching. Meters, radians, seconds.

    Attributes
    ----------
    position_sigma, orientation_sigma : noise of each axis and sample
    frame_of_reference : World:ENU or World:UTM
    outages : (begin, end) in seconds since the start without samples
    """

    timing: Timing = _TIMING
    position_sigma: float = 0.05
    orientation_sigma: float = 0.01
    frame_of_reference: str = ENU
    outages: Intervals = ()

    def __post_init__(self) -> None:
        if self.frame_of_reference not in (ENU, UTM):
            raise ValueError(f"frame_of_reference must be {ENU} or {UTM}; got {self.frame_of_reference!r}")


@dataclass(frozen=True, slots=True)
class RelativePoseModel:
    """Visual odometry: each sample is the pose relative to the last instant. Meters, radians.

    Attributes
    ----------
    position_sigma, orientation_sigma : noise of each axis and sample
    scale_sigma : standard deviation of the scale error, drawn once
    outages : lost samples; the next one is still relative to its own predecessor
    """

    timing: Timing = _TIMING
    position_sigma: float = 0.01
    orientation_sigma: float = 0.002
    scale_sigma: float = 0.0
    outages: Intervals = ()


@dataclass(frozen=True, slots=True)
class RangeModel:
    """Distances to beacons, all at each instant. Meters.

    Attributes
    ----------
    sigma : noise of each distance
    max_range : beacons farther away give no sample
    outages : (begin, end) in seconds since the start without samples
    """

    timing: Timing = _TIMING
    sigma: float = 0.1
    max_range: float = math.inf
    outages: Intervals = ()


def simulate_absolute_poses(model: AbsolutePoseModel, run: Run, frame: str, X_VF: Pose) -> Iterator[AbsolutePoseSample]:
    """Yield samples without end. `X_VF` is the pose of `frame` in the vehicle's moving frame."""
    noise = run.noise("absolute/absolute_pose").prefetch()
    covariance = _covariance(model.position_sigma, model.orientation_sigma)
    for header, t in run.generate_headers(model.timing, "absolute/absolute_pose"):
        shift, turn = noise.vector(model.position_sigma), noise.vector(model.orientation_sigma)
        if is_within(model.outages, t):
            continue
        true = run.drive.at(t).pose_of(X_VF)
        measured = _add_error(run.geodesy.pose_in_utm(true) if model.frame_of_reference == UTM else true, shift, turn)
        yield AbsolutePoseSample(
            header,
            frame,
            model.frame_of_reference,
            position=measured.xyz,
            orientation=measured.wxyz,
            covariance=covariance,
        )


def simulate_relative_poses(model: RelativePoseModel, run: Run, frame: str, X_VF: Pose) -> Iterator[RelativePoseSample]:
    """Yield samples without end, the first at the second instant. `X_VF` as in `simulate_absolute_poses`."""
    noise = run.noise("relative/relative_pose").prefetch()
    scale = 1.0 + noise.normal(model.scale_sigma)
    covariance = _covariance(model.position_sigma, model.orientation_sigma)
    since: int | None = None
    before = Pose()
    for header, t in run.generate_headers(model.timing, "relative/relative_pose"):
        shift, turn = noise.vector(model.position_sigma), noise.vector(model.orientation_sigma)
        here = run.drive.at(t).pose_of(X_VF)
        if since is not None and not is_within(model.outages, t):
            step = before.inverse() @ here
            measured = _add_error(Pose(so3.scale(scale, step.xyz), step.wxyz), shift, turn)
            yield RelativePoseSample(header, frame, since, measured.xyz, measured.wxyz, covariance)
        before, since = here, header.utime


def simulate_ranges(
    model: RangeModel, run: Run, frame: str, X_VF: Pose, beacons: Mapping[str, Vector3]
) -> Iterator[RangeSample]:
    """Yield samples without end. `beacons` are positions in World:ENU, meters, by name; `seq` counts samples."""
    noise = run.noise("range/range").prefetch()
    sigma = max(model.sigma, _MIN_SIGMA)
    seq = 0
    for header, t in run.generate_headers(model.timing, "range/range"):
        errors = {name: noise.normal(model.sigma) for name in beacons}
        if is_within(model.outages, t):
            continue
        here = run.drive.at(t).pose_of(X_VF).xyz
        for name, place in beacons.items():
            distance = math.dist(here, place)
            if distance <= model.max_range:
                measured = max(distance + errors[name], 0.0)
                yield RangeSample(replace(header, seq=seq), frame, name, place, ENU, measured, sigma)
                seq += 1


def _add_error(X: Pose, shift: Vector3, turn: Vector3) -> Pose:
    """Return the pose with an error along the axes of its frame of reference."""
    return Pose(so3.add(X.xyz, shift), so3.multiply(so3.exponential(turn), X.wxyz))


def _covariance(position_sigma: float, orientation_sigma: float) -> tuple[float, ...]:
    """Return the row-major covariance (6, 6) of isotropic position and orientation errors."""
    sigmas = (max(position_sigma, _MIN_SIGMA),) * 3 + (max(orientation_sigma, _MIN_SIGMA),) * 3
    return tuple(sigmas[i] ** 2 if i == j else 0.0 for i in range(6) for j in range(6))


# --- simulation ---------------------------------------------------------------------------------------------


class RoughSimulation(Simulation):
    """`Simulation` on `terrain`, with `side_slip` at an angle to the path, and with aiding sensors.

    A sensor without a frame is absent. `beacons`: positions in World:ENU by name, meters.
    """

    def __init__(
        self,
        model: Model,
        base_frame: str,
        trajectory: Trajectory,
        origin: Origin,
        *,
        rolling_frame: str | None = None,
        seed: int = 1,
        terrain: Terrain | None = None,
        side_slip: SideSlip | None = None,
        pose_frame: str | None = None,
        pose_model: AbsolutePoseModel | None = None,
        odometry_frame: str | None = None,
        odometry_model: RelativePoseModel | None = None,
        range_frame: str | None = None,
        beacons: Mapping[str, Vector3] | None = None,
        range_model: RangeModel | None = None,
        **more: Any,
    ):
        rolling = rolling_frame or base_frame

        def pose_of(frame: str) -> Pose:
            return model.get_transformation(frame, rolling).pose

        aiding: list[Callable[[Run], Iterator[Event]]] = []
        if pose_frame is not None:
            poses, X_VP = pose_model or AbsolutePoseModel(), pose_of(pose_frame)
            aiding.append(lambda run: simulate_absolute_poses(poses, run, pose_frame, X_VP))
        if odometry_frame is not None:
            odometry, X_VO = odometry_model or RelativePoseModel(), pose_of(odometry_frame)
            aiding.append(lambda run: simulate_relative_poses(odometry, run, odometry_frame, X_VO))
        if range_frame is not None and beacons:
            radio, X_VF = range_model or RangeModel(), Pose(pose_of(range_frame).xyz)
            aiding.append(lambda run: simulate_ranges(radio, run, range_frame, X_VF, beacons))
        super().__init__(
            model,
            base_frame,
            trajectory,
            origin,
            rolling_frame=rolling_frame,
            seed=seed,
            motion=make_motion(trajectory, terrain, side_slip, seed),
            more_sensors=aiding,
            **more,
        )


# --- faults of encoders, gyros and accelerometers ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class EncoderModel:
    """Faults of the wheels and encoders; by default none.

    Attributes
    ----------
    burst_rate, burst_seconds, burst_excess : wheel spin of each wheel: starts per second, duration, share of excess
        travel
    stuck : (wheel, time): from then on the encoder gives no pulses
    swapped : wheels that count backward when they roll forward
    """

    burst_rate: float = 0.0
    burst_seconds: float = 1.0
    burst_excess: float = 0.5
    stuck: tuple[tuple[str, float], ...] = ()
    swapped: frozenset[str] = frozenset()

    def __call__(self, model: WheelsModel, name: str, noise: NoiseSource, run: Run) -> FaultyEncoder:
        return FaultyEncoder(self, model, name, noise, run)


class FaultyEncoder(Encoder):
    """One encoder with faults, which draw from a generator of the wheel's own."""

    def __init__(self, faulty: EncoderModel, model: WheelsModel, name: str, noise: NoiseSource, run: Run):
        super().__init__(model, name, noise, run)
        self._faulty, self._faults = faulty, run.noise(f"wheels/wheels/{name}").generator
        self._stuck_from = min((t for wheel, t in faulty.stuck if wheel == name), default=math.inf)
        self._sign = -1.0 if name in faulty.swapped else 1.0
        self._burst = self._faults.exponential(1.0 / faulty.burst_rate) if faulty.burst_rate else math.inf
        self._travel = 0.0

    def sample(self, t: float, rolled: float, speed: float, excess: float, steering: float) -> WheelSample:
        if self._is_spinning(t):
            excess *= 1.0 + self._faulty.burst_excess
        found = super().sample(t, rolled, speed, excess, steering)
        if t >= self._stuck_from:
            found = replace(found, travel=self._travel, speed=0.0, direction=Direction.STOPPED)
        self._travel = found.travel
        if self._sign > 0.0:
            return found
        back = {Direction.FORWARD: Direction.BACKWARD, Direction.BACKWARD: Direction.FORWARD}
        direction = back.get(found.direction, found.direction)
        return replace(found, travel=-found.travel, speed=-found.speed, direction=direction)

    def _is_spinning(self, t: float) -> bool:
        faulty = self._faulty
        while t >= self._burst + faulty.burst_seconds:
            self._burst += faulty.burst_seconds + self._faults.exponential(1.0 / faulty.burst_rate)
        return t >= self._burst


_MOVING_SPEED = 0.05
"""Speed in m/s above which the vehicle vibrates."""


@dataclass(frozen=True, slots=True)
class TriadModel:
    """Errors of three gyros or accelerometers beyond white noise and constant bias, in rad/s or m/s2; 0 for none.

    Attributes
    ----------
    scale_sigma : standard deviation of each axis's scale error, drawn once
    misalignment_sigma : standard deviation of the misalignment between two axes, rad, drawn once
    instability : standard deviation of the in-run bias, a Gauss-Markov process of `instability_time` seconds
    walk : random walk of the bias, unit/sqrt(s)
    vibration : standard deviation of each sample's vibration while the vehicle moves
    """

    scale_sigma: float = 0.0
    misalignment_sigma: float = 0.0
    instability: float = 0.0
    instability_time: float = 300.0
    walk: float = 0.0
    vibration: float = 0.0

    def __call__(self, rate_hz: float, noise: NoiseSource) -> Callable[[Vector3, float], Vector3]:
        return Triad(self, rate_hz, noise).measure


class Triad:
    """One simulated triad of gyros or accelerometers: y = M x + b_walk(t) + b_instability(t) + vibration.

    M has scale errors and misalignment drawn once, b_walk is a random walk, b_instability a first-order Gauss-Markov
    process.
    """

    def __init__(self, model: TriadModel, rate_hz: float, noise: NoiseSource):
        self._model = model
        self._noise = noise.prefetch()
        misalignment = [noise.vector(model.misalignment_sigma) for _ in range(3)]
        scale = noise.vector(model.scale_sigma)
        x, y, z = ([1.0 + scale[i] if i == j else misalignment[i][j] for j in range(3)] for i in range(3))
        self._rows = (so3.to_vector3(x), so3.to_vector3(y), so3.to_vector3(z))
        self._instability = [GaussMarkov(model.instability, model.instability_time, noise) for _ in range(3)]
        self._walk = (0.0, 0.0, 0.0)
        self._drift = model.walk / math.sqrt(rate_hz)
        self._period = 1.0 / rate_hz

    def measure(self, true: Vector3, speed: float) -> Vector3:
        """Return the measured vector for a true one at the vehicle's `speed`, m/s."""
        model = self._model
        if self._drift:
            self._walk = so3.add(self._walk, self._noise.vector(self._drift))
        errors = [self._walk]
        if model.instability:
            errors.append(so3.to_vector3(each.step(self._period) for each in self._instability))
        if model.vibration and abs(speed) > _MOVING_SPEED:
            errors.append(self._noise.vector(model.vibration))
        return so3.add(apply_rows(self._rows, true), so3.add(*errors))


# --- sensors without errors -------------------------------------------------------------------------------------------


def make_noise_free_gps(timing: Timing = Timing(4.0)) -> GpsModel:  # noqa: B008 - immutable
    return GpsModel(timing, correlated_sigma=0.0, white_sigma=0.0, velocity_sigma=0.0, baseline_sigma=0.0)


def make_noise_free_wheels(
    timing: Timing = Timing(20.0),  # noqa: B008 - immutable
    steered: frozenset[str] = frozenset(),
) -> WheelsModel:
    return WheelsModel(timing, scale_sigma=0.0, speed_sigma=0.0, travel_step=0.0, steered=steered)


def make_noise_free_imu(
    timing: Timing = Timing(100.0),  # noqa: B008 - immutable
    yaw_offset: float = 0.0,
    earth_rotation: bool = True,
) -> ImuModel:
    """Return a unit without error; its yaw still starts at `yaw_offset` and integrates its gyros."""
    return ImuModel(
        timing,
        gyro_bias_sigma=0.0,
        gyro_walk=0.0,
        gyro_noise=0.0,
        accelerometer_bias_sigma=0.0,
        accelerometer_noise=0.0,
        tilt_sigma=0.0,
        tilt_noise=0.0,
        yaw_offset=yaw_offset,
        earth_rotation=earth_rotation,
    )
