"""Maneuvers: phases of a `Trajectory`. Speeds in m/s, times in seconds, lengths and radii in meters."""

from __future__ import annotations

import math

from modelserver.simulation.noise import NoiseSource
from modelserver.simulation.trajectory import DrivePhase, Trajectory

_LOOP_ANGLE = 3.0 * math.pi / 2.0
"""Turn of each loop of the figure eight: its straights cross at a right angle."""


def straight(
    speed: float = 2.0, length: float = 30.0, stationary: float = 4.0, ramp: float = 3.0
) -> tuple[DrivePhase, ...]:
    """Return: stationary, drive `length` straight ahead, stop, stationary as long again.

    `ramp` is the time to reach the speed and to stop; a negative speed drives backward. Raises ValueError where the
    ramps alone are longer.
    """
    cruise = length / abs(speed) - ramp
    if cruise <= 0:
        raise ValueError(f"length {length:g} m is too short for two ramps of {ramp:g} s at {speed:g} m/s")
    return (
        DrivePhase(stationary),
        DrivePhase(ramp, speed),
        DrivePhase(cruise),
        DrivePhase(ramp, 0.0),
        DrivePhase(stationary),
    )


def figure_eight(
    speed: float = 2.0,
    radius: float = 8.0,
    stationary: float = 4.0,
    laps: int = 1,
    ramp: float = 3.0,
    stop: float = 0.0,
    reverse: float = 0.0,
) -> tuple[DrivePhase, ...]:
    """Return: stationary, drive off, `laps` times round an eight of two loops of `radius`, stop, stationary.

    The steering goes from straight to full lock in `ramp` seconds, and the speed from 0 to `speed`. With `stop` the
    vehicle halts for that time in the middle of the straight that ends each lap; with `reverse` it then backs up for
    that time at half the speed, and halts again. Except for these, each lap closes on itself. Raises ValueError for
    impossible values.
    """
    if speed <= 0 or radius <= 0 or laps < 1:
        raise ValueError(f"speed and radius must be positive, laps at least 1; got {speed}, {radius}, {laps}")
    curvature = 1.0 / radius
    # each steering ramp turns by half of ramp * speed * curvature
    hold = _LOOP_ANGLE / (speed * curvature) - ramp
    if hold <= 0:
        raise ValueError(f"a loop of {radius:g} m at {speed:g} m/s is shorter than {ramp:g} s of steering")
    # length of the straights for which the tangents at both ends of a loop meet in the crossing
    probe = Trajectory(
        (
            DrivePhase(ramp, speed),
            DrivePhase(ramp, curvature=curvature),
            DrivePhase(hold),
            DrivePhase(ramp, curvature=0.0),
            DrivePhase(1.0, 0.0),
        )
    )
    (x0, _, _), (x1, _, _) = probe.at(ramp).position, probe.at(3 * ramp + hold).position
    half = (x0 - x1) / (1.0 + math.cos(_LOOP_ANGLE)) / speed
    if half <= 0:
        raise ValueError(f"ramp {ramp:g} s is too long for a loop of {radius:g} m at {speed:g} m/s")

    def loop(side: float) -> tuple[DrivePhase, ...]:
        return (DrivePhase(ramp, curvature=side * curvature), DrivePhase(hold), DrivePhase(ramp, curvature=0.0))

    lap = [DrivePhase(half), *loop(1.0), DrivePhase(2.0 * half), *loop(-1.0), DrivePhase(half)]
    halt = [DrivePhase(ramp, 0.0), DrivePhase(max(stop, 1.0))]
    if stop > 0 or reverse > 0:
        lap += halt
        if reverse > 0:
            lap += [DrivePhase(ramp, -speed / 2.0), DrivePhase(reverse), *halt]
        lap.append(DrivePhase(ramp, speed))
    wait = [DrivePhase(stationary)] if stationary > 0 else []
    return (*wait, DrivePhase(ramp, speed), *lap * laps, DrivePhase(ramp, 0.0), *wait)


def stationary(seconds: float) -> tuple[DrivePhase, ...]:
    return (DrivePhase(seconds),)


_MAX_LATERAL_ACCELERATION = 2.0
"""m/s2 that a driver does not exceed in a turn in town."""

_MEAN_ACCELERATION = 1.5
"""m/s2, the upper end of the mean acceleration when driving off and stopping."""


def city(seed: int, seconds: float = 120.0, speed: float = 6.0, min_radius: float = 6.0) -> tuple[DrivePhase, ...]:
    """Return a random drive of `seconds`: straights, turns either way, stops, reversing; stationary at both ends.

    `speed` is the largest, `min_radius` the smallest radius. The same seed gives the same drive. Raises ValueError for
    less than 20 seconds, or for a limit that is not positive.
    """
    if not (seconds >= 20.0 and speed > 0 and min_radius > 0):
        raise ValueError(
            f"seconds must be at least 20, speed and radius positive; got {seconds}, {speed}, {min_radius}"
        )
    chance = NoiseSource(seed, "city").generator
    phases = [DrivePhase(chance.uniform(2.0, 4.0))]
    left = seconds - phases[0].duration
    now = 0.0

    def to(target: float) -> DrivePhase:
        """Return the phase that reaches a speed, with a random acceleration."""
        return DrivePhase(
            max(1.5, abs(target - now) / chance.uniform(0.5 * _MEAN_ACCELERATION, _MEAN_ACCELERATION)), target
        )

    while True:
        part: list[DrivePhase] = []
        end = now
        kind = chance.integers(6) if now else 5
        if kind == 4:
            part, end = [to(0.0), DrivePhase(chance.uniform(1.0, 6.0))], 0.0
        elif kind == 3:
            back = -chance.uniform(0.2, 0.4) * speed
            bend = chance.uniform(-1.0, 1.0) / min_radius
            part = [to(0.0), DrivePhase(chance.uniform(0.5, 2.0)), DrivePhase(2.0, back, bend)]
            part += [
                DrivePhase(chance.uniform(1.0, 5.0)),
                DrivePhase(2.0, 0.0, 0.0),
                DrivePhase(chance.uniform(0.5, 2.0)),
            ]
            end = 0.0
        elif kind in (1, 2):
            bend = math.copysign(1.0, chance.uniform(-1.0, 1.0)) / (min_radius * chance.uniform(1.0, 4.0))
            slow = min(now, math.sqrt(_MAX_LATERAL_ACCELERATION / abs(bend)))
            # a steering ramp turns by half of what full lock does
            hold = max(chance.uniform(0.3, 2.0) / (abs(bend) * slow) - 1.5, 0.2)
            part, end = [to(slow), DrivePhase(1.5, None, bend), DrivePhase(hold), DrivePhase(1.5, None, 0.0)], slow
        elif kind == 0:
            part = [DrivePhase(chance.uniform(1.0, 6.0))]
        else:
            end = chance.uniform(0.4, 1.0) * speed
            part = [to(end), DrivePhase(chance.uniform(0.5, 4.0))]
        # keep enough time to stop
        if sum(phase.duration for phase in part) + end / (0.5 * _MEAN_ACCELERATION) + 2.0 > left:
            break
        phases += part
        left -= sum(phase.duration for phase in part)
        now = end
    if now:
        stopping = max(1.5, now / (0.5 * _MEAN_ACCELERATION))
        phases.append(DrivePhase(stopping, 0.0))
        left -= stopping
    return (*phases, DrivePhase(left))
