"""Figures to drive, as phases of a `Trajectory`."""

from __future__ import annotations

import math

from modelserver.simulation.noise import NoiseSource
from modelserver.simulation.trajectory import DrivePhase, Trajectory

_QUARTERS = 3.0 * math.pi / 2.0
"""How far each loop of the eight turns: the straights then cross at a right angle."""


def straight(speed: float = 2.0, length: float = 30.0, stand: float = 4.0, ramp: float = 3.0) -> tuple[DrivePhase, ...]:
    """Return: stand, drive `length` metres straight ahead, stop, stand as long again.

    Speed in m/s, times in seconds; `ramp` is the time to reach the speed and to stop. The direction of
    `speed` counts: below 0 it is driven backwards. Raises ValueError where the ramps alone are longer.
    """
    cruise = length / abs(speed) - ramp
    if cruise <= 0:
        raise ValueError(f"{length:g} m at {speed:g} m/s leave no way between two ramps of {ramp:g} s")
    return (DrivePhase(stand), DrivePhase(ramp, speed), DrivePhase(cruise), DrivePhase(ramp, 0.0), DrivePhase(stand))


def figure_eight(
    speed: float = 2.0,
    radius: float = 8.0,
    stand: float = 4.0,
    laps: int = 1,
    ramp: float = 3.0,
    stop: float = 0.0,
    reverse: float = 0.0,
) -> tuple[DrivePhase, ...]:
    """Return: stand, set off, `laps` times round an eight of two loops of `radius` metres, stop, stand.

    Speed in m/s, times in seconds. The steering moves between straight and full lock during `ramp`, and so
    does the speed between rest and `speed`. With `stop` the vehicle halts for so long in the middle of the
    straight that ends each lap; with `reverse` it then backs up for so long, at half the speed, and halts again.
    Each lap closes on itself but for the ways of stop and reverse.
    """
    if speed <= 0 or radius <= 0 or laps < 1:
        raise ValueError(f"an eight takes a speed, a radius and a lap or more, got {speed}, {radius}, {laps}")
    curvature = 1.0 / radius
    # entering and leaving a loop turn by half of ramp * speed * curvature each
    hold = _QUARTERS / (speed * curvature) - ramp
    if hold <= 0:
        raise ValueError(f"a loop of {radius:g} m at {speed:g} m/s is over before {ramp:g} s of steering are")
    # the straights are as long as it takes for the tangents at both ends of a loop to meet in the crossing
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
    half = (x0 - x1) / (1.0 + math.cos(_QUARTERS)) / speed
    if half <= 0:
        raise ValueError(f"{ramp:g} s of steering are too long for a loop of {radius:g} m at {speed:g} m/s")

    def loop(side: float) -> tuple[DrivePhase, ...]:
        return (DrivePhase(ramp, curvature=side * curvature), DrivePhase(hold), DrivePhase(ramp, curvature=0.0))

    phases = [DrivePhase(stand), DrivePhase(ramp, speed)] if stand > 0 else [DrivePhase(ramp, speed)]
    for _ in range(laps):
        phases += [DrivePhase(half), *loop(1.0), DrivePhase(2.0 * half), *loop(-1.0), DrivePhase(half)]
        if stop > 0 or reverse > 0:
            phases += [DrivePhase(ramp, 0.0), DrivePhase(max(stop, 1.0))]
            if reverse > 0:
                phases += [
                    DrivePhase(ramp, -speed / 2.0),
                    DrivePhase(reverse),
                    DrivePhase(ramp, 0.0),
                    DrivePhase(max(stop, 1.0)),
                ]
            phases.append(DrivePhase(ramp, speed))
    phases.append(DrivePhase(ramp, 0.0))
    if stand > 0:
        phases.append(DrivePhase(stand))
    return tuple(phases)


def there_and_back(
    speed: float = 2.0, length: float = 20.0, stand: float = 4.0, ramp: float = 3.0
) -> tuple[DrivePhase, ...]:
    """Return: stand, drive `length` metres ahead, stop, stand, back up to the start, stand."""
    return straight(speed, length, stand, ramp) + straight(-speed, length, stand, ramp)[1:]


def reverse_eight(
    speed: float = 2.0, radius: float = 8.0, stand: float = 4.0, laps: int = 1, ramp: float = 3.0
) -> tuple[DrivePhase, ...]:
    """Return `figure_eight` driven backward from the start on; `speed` is its size."""
    return tuple(
        DrivePhase(phase.duration, None if phase.speed is None else -phase.speed, phase.curvature)
        for phase in figure_eight(speed, radius, stand, laps, ramp)
    )


def stand(seconds: float) -> tuple[DrivePhase, ...]:
    """Return: stand."""
    return (DrivePhase(seconds),)


def stop_and_go(
    speed: float = 3.0,
    go: float = 6.0,
    stop: float = 3.0,
    times: int = 5,
    ramp: float = 2.0,
    curvature: float = 0.0,
) -> tuple[DrivePhase, ...]:
    """Return: stand, then `times` over set off, go on for `go` seconds, stop, stand for `stop` seconds.

    `curvature` (1/m) is that of every going, to either side in turn.
    """
    phases = [DrivePhase(stop)]
    for number in range(times):
        side = curvature if number % 2 == 0 else -curvature
        phases += [DrivePhase(ramp, speed, side), DrivePhase(go), DrivePhase(ramp, 0.0, 0.0), DrivePhase(stop)]
    return tuple(phases)


_LATERAL = 2.0
"""m/s2 across that a driver in town does not pass in a turn."""

_PUSH = 1.5
"""m/s2, on average, with which he sets off and stops at most."""


def city(seed: int, seconds: float = 120.0, speed: float = 6.0, tightest: float = 6.0) -> tuple[DrivePhase, ...]:
    """Return a random drive of `seconds`: straights, turns either way, stops, backing up; at rest at both ends.

    `speed` is the largest in m/s, `tightest` the smallest radius in metres. The same seed gives the same drive.
    Raises ValueError for less than 20 seconds, or where a limit is not above 0.
    """
    if not (seconds >= 20.0 and speed > 0 and tightest > 0):
        raise ValueError(f"a drive in town takes 20 s, a speed and a radius, got {seconds}, {speed}, {tightest}")
    chance = NoiseSource(seed, "city")
    phases = [DrivePhase(chance.uniform(2.0, 4.0))]
    left = seconds - phases[0].duration
    now = 0.0

    def to(target: float) -> DrivePhase:
        """Reach a speed; how hard differs from time to time."""
        return DrivePhase(max(1.5, abs(target - now) / chance.uniform(0.5 * _PUSH, _PUSH)), target)

    while True:
        part: list[DrivePhase] = []
        end = now
        kind = chance.index(6) if now else 5
        if kind == 4:
            part, end = [to(0.0), DrivePhase(chance.uniform(1.0, 6.0))], 0.0
        elif kind == 3:
            back = -chance.uniform(0.2, 0.4) * speed
            bend = chance.uniform(-1.0, 1.0) / tightest
            part = [to(0.0), DrivePhase(chance.uniform(0.5, 2.0)), DrivePhase(2.0, back, bend)]
            part += [
                DrivePhase(chance.uniform(1.0, 5.0)),
                DrivePhase(2.0, 0.0, 0.0),
                DrivePhase(chance.uniform(0.5, 2.0)),
            ]
            end = 0.0
        elif kind in (1, 2):
            bend = math.copysign(1.0, chance.uniform(-1.0, 1.0)) / (tightest * chance.uniform(1.0, 4.0))
            slow = min(now, math.sqrt(_LATERAL / abs(bend)))
            # the steering alone turns by half of what it does at full lock
            hold = max(chance.uniform(0.3, 2.0) / (abs(bend) * slow) - 1.5, 0.2)
            part, end = [to(slow), DrivePhase(1.5, None, bend), DrivePhase(hold), DrivePhase(1.5, None, 0.0)], slow
        elif kind == 0:
            part = [DrivePhase(chance.uniform(1.0, 6.0))]
        else:
            end = chance.uniform(0.4, 1.0) * speed
            part = [to(end), DrivePhase(chance.uniform(0.5, 4.0))]
        # what is left must do to stop
        if sum(phase.duration for phase in part) + end / (0.5 * _PUSH) + 2.0 > left:
            break
        phases += part
        left -= sum(phase.duration for phase in part)
        now = end
    if now:
        stopping = max(1.5, now / (0.5 * _PUSH))
        phases.append(DrivePhase(stopping, 0.0))
        left -= stopping
    return (*phases, DrivePhase(left))
