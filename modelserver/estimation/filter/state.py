"""State of the filter at an instant: what is restored when an out-of-sequence measurement arrives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from modelserver.earth.geodesy import Geodesy, LocalFrame
from modelserver.estimation.filter.alignment import Passed
from modelserver.estimation.filter.nav import Nav
from modelserver.estimation.filter.stationary import Stillness
from modelserver.estimation.filter.strapdown import Earth
from modelserver.estimation.origin import OriginCapture
from modelserver.messages import Mode, Origin, Phase, RestoredState, Sample, SwitchMode
from modelserver.transforms.so3 import Vector3

LINE = 3e-4
"""How near, as a share, two changes must be to lie on one line: stamps of whole microseconds, 100 times a second."""

MADE_UP = 3
"""Samples in a row along one line, in all six numbers, that cannot be chance."""


class Last(NamedTuple):
    """The last measurement of a kind from a source that was compared: its instant, and its sample."""

    utime: int
    sample: Sample | SwitchMode


class Said(NamedTuple):
    """What an inertial unit said last, at `utime`: is it alive?

    `since` is from when on it says nothing else. `slope` is the change a second of its six numbers, and `even` how many
    samples in a row have gone on along exactly that line.
    """

    utime: int
    rate: Vector3
    force: Vector3
    since: int
    slope: tuple[float, ...] = ()
    even: int = 0

    def followed(self, utime: int, rate: Vector3, force: Vector3) -> Said:
        """Return what it said with one sample more."""
        dt = (utime - self.utime) * 1e-6
        if dt <= 0.0:
            return self
        if rate == self.rate and force == self.force:
            return self._replace(utime=utime, slope=(), even=self.even + 1 if not self.slope else 1)
        (a, b, c), (d, e, f) = self.rate, self.force
        (g, h, i), (j, k, m) = rate, force
        slope = ((g - a) / dt, (h - b) / dt, (i - c) / dt, (j - d) / dt, (k - e) / dt, (m - f) / dt)
        on_line = bool(self.slope) and all(
            abs(x - y) <= LINE * (0.3 + abs(x) + abs(y)) for x, y in zip(slope, self.slope, strict=True)
        )
        return Said(utime, rate, force, utime, slope, self.even + 1 if on_line else 0)

    @property
    def made_up(self) -> bool:
        """Whether the numbers go along a line, or stay, as no noise lets them: someone filled a gap with them."""
        return self.even >= MADE_UP


class Pending(NamedTuple):
    """A decision that takes effect at `utime`, when no sample that comes late can change it any more."""

    utime: int
    origin: Origin | None = None
    take_up: bool = False


class Steering(NamedTuple):
    """The steering angle (rad) that the vehicle controller measured last, at `utime`; nan where it measures none."""

    utime: int = 0
    angle: float = math.nan


class Resuming(NamedTuple):
    """What an earlier run kept, while it waits for evidence.

    `since` is when it began to wait, 0 before levelling, `looked` the last look at the evidence. `fixes` counts those
    in a row that agree with the kept pose, below 0 those that do not; `seen` is the last one's instant.
    """

    recalled: RestoredState
    since: int = 0
    looked: int = 0
    fixes: int = 0
    seen: int = 0


WHEELS_LAST = 1_000_000
"""Microseconds for which what wheels said tells how fast the vehicle goes."""


class Proving(NamedTuple):
    """A stretch of fixes that a resumed heading is held against, from `begin` to `utime` (0: none yet).

    `place` is where the rolling frame was by the first fix, `way` what was driven since along the heading, metres, and
    `velocity` what it is now, m/s; all complex, east + i north.
    """

    utime: int = 0
    begin: int = 0
    place: complex = 0j
    way: complex = 0j
    velocity: complex = 0j


class FilterState(NamedTuple):
    """Nominal state, covariance, and everything that decisions rest on. Make the first with the engine's `first`.

    `nav` is None while levelling. `site` is the tangent plane that N is east, north, up of once `phase` is ALIGNED.
    `imu_utime` is the last inertial sample used, `heard` the first of levelling, `began` the first of its mean;
    `said` what the unit said, and `guessed` whether that was made up; `wheels_utime` the last wheels used, and
    `wheels_source` who told them. `passed` are fixes beside the way, for heading;
    `unit` the way at speed 1 so far (s). `refused` are the fixes refused in a row, `refused_since` the first of
    them; `confirmed` counts the fixes that were used, and `fix_utime` is the last that was used or confirmed.
    `moved` is until when fixes say that the vehicle moves. `restless` is by how much faster than the settings say
    what lingers in fixes wanders. `shown` is how far the pose goes with what lingers in fixes, metres along N,
    `doubt` the variance that this adds, and `anchored` when another source last told the place along each axis.
    `allowance` is what one outlier just within its gate may have moved the position by, metres, and
    `conflict_utime` when a fix from beyond its gate was last used. `biases` are the gyros' with their sigma, kept
    where the rest begins anew. `tilt` is how far gravity is off the geometry's up at start-up, where that is too
    far; infinite where what is felt is no gravity. `warm_start` is what an earlier run stored, until it is used or not;
    `proving` what a resumed heading is held against, until it is right or not. `steering` is the vehicle controller's
    steering angle. Before heading is known, `gained` (m/s) and `swept` (m) are the first and the second integral of the
    inertial unit's horizontal acceleration along N, and `undirected` is whether heading lacks only the direction of
    travel: forward or backward.
    """

    nav: Nav | None = None
    stillness: Stillness = Stillness()
    said: Said | None = None
    imu_utime: int = 0
    phase: Phase = Phase.LEVELING
    mode: Mode = Mode.FULL
    earth: Earth = Earth()
    site: LocalFrame | None = None
    geodesy: Geodesy | None = None
    capture: OriginCapture = OriginCapture()
    pending: tuple[Pending, ...] = ()
    standing: bool = False
    began: int = 0
    heard: int = 0
    guessed: bool = False
    wheels_utime: int = 0
    wheels_rate: float = 0.0
    wheels_source: str = ""
    last: Mapping[tuple[str, str], Last] = MappingProxyType({})
    rolled_utime: int = 0
    rested_utime: int = 0
    passed: tuple[Passed, ...] = ()
    unit: complex = 0j
    refused: tuple[Passed, ...] = ()
    refused_since: int = 0
    refused_count: int = 0
    fix_utime: int = 0
    confirmed: int = 0
    moved: int = 0
    fixed: Passed | None = None
    restless: float = 1.0
    shown: Vector3 = (0.0, 0.0, 0.0)
    doubt: Vector3 = (0.0, 0.0, 0.0)
    anchored: tuple[int, int, int] = (0, 0, 0)
    allowance: float = 0.0
    conflict_utime: int = 0
    epoch: int = 0
    tilt: float = 0.0
    level_force: Vector3 = (0.0, 0.0, 0.0)
    level_rate: Vector3 = (0.0, 0.0, 0.0)
    level_count: int = 0
    biases: tuple[Vector3, float] | None = None
    stepped: bool = False
    warm_start: Resuming | None = None
    proving: Proving | None = None
    steering: Steering = Steering()
    gained: complex = 0j
    swept: complex = 0j
    undirected: bool = False

    def on_wheels(self, utime: int) -> bool:
        """Return whether wheels tell how fast the vehicle goes at an instant."""
        return self.mode is not Mode.NO_WHEELS and self.wheels_utime > 0 and utime - self.wheels_utime < WHEELS_LAST

    def felt(self, nav: Nav, stillness: Stillness, said: Said, imu_utime: int) -> FilterState:
        """Return the state after an inertial sample.

        What `_replace` does, at a quarter of its cost: this is done for every one. The four stand first for it.
        """
        return FilterState._make((nav, stillness, said, imu_utime, *self[4:]))
