"""Figures to drive, as phases of a `Trajectory`."""

from __future__ import annotations

import math

from modelserver.simulation.trajectory import Phase, Trajectory

_QUARTERS = 3.0 * math.pi / 2.0
"""How far each loop of the eight turns: the straights then cross at a right angle."""


def straight(speed: float = 2.0, length: float = 30.0, stand: float = 4.0, ramp: float = 3.0) -> tuple[Phase, ...]:
    """Return: stand, drive `length` metres straight ahead, stop, stand as long again.

    Speed in m/s, times in seconds; `ramp` is the time to reach the speed and to stop. The direction of
    `speed` counts: below 0 it is driven backwards. Raises ValueError where the ramps alone are longer.
    """
    cruise = length / abs(speed) - ramp
    if cruise <= 0:
        raise ValueError(f"{length:g} m at {speed:g} m/s leave no way between two ramps of {ramp:g} s")
    return (Phase(stand), Phase(ramp, speed), Phase(cruise), Phase(ramp, 0.0), Phase(stand))


def figure_eight(
    speed: float = 2.0,
    radius: float = 8.0,
    stand: float = 4.0,
    laps: int = 1,
    ramp: float = 3.0,
    stop: float = 0.0,
    reverse: float = 0.0,
) -> tuple[Phase, ...]:
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
        (Phase(ramp, speed), Phase(ramp, curvature=curvature), Phase(hold), Phase(ramp, curvature=0.0), Phase(1.0, 0.0))
    )
    (x0, _, _), (x1, _, _) = probe.at(ramp).position, probe.at(3 * ramp + hold).position
    half = (x0 - x1) / (1.0 + math.cos(_QUARTERS)) / speed
    if half <= 0:
        raise ValueError(f"{ramp:g} s of steering are too long for a loop of {radius:g} m at {speed:g} m/s")

    def loop(side: float) -> tuple[Phase, ...]:
        return (Phase(ramp, curvature=side * curvature), Phase(hold), Phase(ramp, curvature=0.0))

    phases = [Phase(stand), Phase(ramp, speed)] if stand > 0 else [Phase(ramp, speed)]
    for _ in range(laps):
        phases += [Phase(half), *loop(1.0), Phase(2.0 * half), *loop(-1.0), Phase(half)]
        if stop > 0 or reverse > 0:
            phases += [Phase(ramp, 0.0), Phase(max(stop, 1.0))]
            if reverse > 0:
                phases += [Phase(ramp, -speed / 2.0), Phase(reverse), Phase(ramp, 0.0), Phase(max(stop, 1.0))]
            phases.append(Phase(ramp, speed))
    phases.append(Phase(ramp, 0.0))
    if stand > 0:
        phases.append(Phase(stand))
    return tuple(phases)


def there_and_back(
    speed: float = 2.0, length: float = 20.0, stand: float = 4.0, ramp: float = 3.0
) -> tuple[Phase, ...]:
    """Return: stand, drive `length` metres ahead, stop, stand, back up to the start, stand."""
    return straight(speed, length, stand, ramp) + straight(-speed, length, stand, ramp)[1:]
