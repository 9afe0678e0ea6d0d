"""Drives of tests, beside those of `modelserver.simulation.maneuvers`."""

from __future__ import annotations

from modelserver.simulation import DrivePhase, figure_eight, straight


def there_and_back(
    speed: float = 2.0, length: float = 20.0, stationary: float = 4.0, ramp: float = 3.0
) -> tuple[DrivePhase, ...]:
    """Return: stationary, drive `length` ahead, stop, stationary, back up to the start, stationary."""
    return straight(speed, length, stationary, ramp) + straight(-speed, length, stationary, ramp)[1:]


def reverse_eight(
    speed: float = 2.0, radius: float = 8.0, stationary: float = 4.0, laps: int = 1, ramp: float = 3.0
) -> tuple[DrivePhase, ...]:
    """Return `figure_eight` driven backward; `speed` is its magnitude."""
    return tuple(
        DrivePhase(phase.duration, None if phase.speed is None else -phase.speed, phase.curvature)
        for phase in figure_eight(speed, radius, stationary, laps, ramp)
    )


def stop_and_go(
    speed: float = 3.0,
    go: float = 6.0,
    stop: float = 3.0,
    times: int = 5,
    ramp: float = 2.0,
    curvature: float = 0.0,
) -> tuple[DrivePhase, ...]:
    """Return: stationary, then `times` over: drive off, go on for `go` seconds, stop, stationary for `stop` seconds.

    `curvature` (1/m) is that of each drive, alternating left and right.
    """
    phases = [DrivePhase(stop)]
    for number in range(times):
        side = curvature if number % 2 == 0 else -curvature
        phases += [DrivePhase(ramp, speed, side), DrivePhase(go), DrivePhase(ramp, 0.0, 0.0), DrivePhase(stop)]
    return tuple(phases)
