"""The instant of a measurement from a device's clock: offset and drift against the host's clock, and their doubt.

A sample is measured at the device's time and received later by a delay that varies: host minus device time is the
offset of the two clocks plus that delay. The delay is never negative, so the offset is the lower envelope of the
differences, a line whose slope is the drift (Moon, Skelly and Towsley, "Estimation and removal of clock skew from
network delay measurements", INFOCOM 1999). Here the line is not only found but averaged over all that the samples
allow (`clock_line`). That gives the offset's standard deviation with it, from the first sample on.

The shortest delay of the way itself cannot be told from an offset: it is configured, not estimated. Nor can a way that
has become longer from a device's clock that was set back: the line stays while older samples hold it, follows then,
and the standard deviation covers both. It does so for a window longer; for good, until samples come as early as before,
where the line had to be set up anew; and for a window where that was by half a second and more, for no way is so long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from msdrivers.clock_line import ClockLine, Point, SampleBlock, fitted

BLOCK_US = 2_000_000
WINDOW_US = 120_000_000
"""The envelope is kept for two minutes, as the lowest samples of every two seconds: drifts change slowly, but do."""

LARGEST_DRIFT = 1e-2
"""Beyond any crystal: a tick whose length was told wrongly may still be so far off."""

SLACK_US = 5_000.0
"""By how much a sample must leave the band of the delays before the clocks are suspected."""

LATE_SAMPLES = 8
LATE_US = 1_000_000
"""A sample that is too late is taken for delayed, until so many in a row have been, for so long on the host's clock."""

LOST_US = 60_000_000
"""No delay is so long: a clock has stepped."""

STEP_US = 500_000.0
"""A way that became longer by so much and stays so is no way: receivers that learn of leap seconds step so."""

BEGIN_US = 1_000_000
BEGIN_DOUBT_US = 150_000.0
"""In its first second all that came may have been held up: the doubt falls from this to nothing."""

CLIP = 3.0
"""A delay counts as at most this many times the usual spread, so that one long stall does not widen it."""

HOST_US = 50.0
"""What the host's own stamp is good for, standard deviation."""

INFLATION = 1.4
"""On the standard deviation: the doubt is one-sided, and within two deviations of it lie 95 % only just."""


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """What is known of a device's clock. Every sample gives a new one; cost and size are bounded.

    tick_us: the device's time goes in steps so long, rounded down. max_drift: by so much a clock is off at most, as a
    fraction; more is thought of once the samples ask for it.
    restarts: how often a clock was seen to step.
    """

    tick_us: float = 1.0
    max_drift: float = 200e-6
    restarts: int = 0
    _blocks: tuple[SampleBlock, ...] = ()
    _line: ClockLine | None = None
    _last_us: int | None = None
    _begun_us: int = 0
    _late: int = 0
    _late_since_us: int = 0
    _risen: float = 0.0
    """By how much the line was set up anew too high if it was the way that became longer, microseconds."""
    _believed_us: int | None = None
    """The device's time from which on that is taken for its clock's."""
    _raised: float = 0.0
    _raised_until_us: int = 0
    """The most by which the lower edge left the line, within the window."""

    @property
    def offset(self) -> float:
        """Host minus device time at the last sample, seconds; nan before the first."""
        if self._line is None or self._last_us is None:
            return math.nan
        return self._line.predict(self._last_us)[0] * 1e-6

    @property
    def drift(self) -> float:
        """How much faster the host's clock runs than the device's, as a fraction; nan before the first sample."""
        return math.nan if self._line is None else self._line.drift

    def take(self, device_us: int, host_us: int) -> tuple[DeviceClock, int, float]:
        """Take a sample; return the clock after it, the sample's instant on the host's clock, and its sigma.

        `device_us` is the device's time without wraps, `host_us` when the host received it on a clock that nobody
        sets: microseconds. The instant is in microseconds too, its standard deviation in seconds.
        """
        difference = host_us - device_us
        if self._line is None:
            return self._restarted(device_us, difference, 0.0)
        offset, variance = self._line.predict(device_us)
        excess = difference - offset
        usual = self.tick_us + self._line.jitter + 3.0 * math.sqrt(variance)
        if excess > LOST_US:
            return replace(self, restarts=self.restarts + 1)._restarted(device_us, difference, 0.0)
        if excess < -usual - SLACK_US:
            return replace(self, restarts=self.restarts + 1)._restarted(device_us, difference, self._risen + excess)
        if excess > usual + SLACK_US:
            since = self._late_since_us if self._late else host_us
            late = self._late + 1
            if late >= LATE_SAMPLES and host_us - since >= LATE_US:
                clock = replace(self, restarts=self.restarts + 1)
                return clock._restarted(device_us, difference, self._risen + excess)
            clock = replace(self, _late=late, _late_since_us=since, _last_us=device_us)
            return clock._answer(device_us, excess)
        clock = self
        if device_us != self._last_us:
            counted = min(difference, round(offset + CLIP * self._line.jitter))
            clock = self._absorbed(device_us, difference, counted)
        elif self._late:
            clock = replace(self, _late=0)
        return clock._answer(device_us, excess if excess > CLIP * usual else 0.0)

    def _restarted(self, device_us: int, difference: int, risen: float) -> tuple[DeviceClock, int, float]:
        block = SampleBlock.begun(Point(device_us, difference), difference)
        clock = replace(
            self,
            _blocks=(block,),
            _line=fitted((block,), device_us, 0.0, self.max_drift),
            _last_us=device_us,
            _begun_us=device_us,
            _late=0,
            _raised=0.0,
            _risen=max(0.0, risen),
            _believed_us=device_us + WINDOW_US if risen >= STEP_US else None,
        )
        return clock._answer(device_us, 0.0)

    def _absorbed(self, device_us: int, difference: int, counted: int) -> DeviceClock:
        assert self._line is not None
        last, point = self._blocks[-1], Point(device_us, difference)
        if device_us - last.start >= BLOCK_US:
            block = SampleBlock.begun(point, counted)
            recent = (each for each in self._blocks if abs(device_us - each.start) < WINDOW_US)
            blocks = (*recent, block)
        else:
            block = last.taken(point, counted, self.max_drift)
            blocks = (*self._blocks[:-1], block)
        # a sample above the envelope changes only how many there were, which tells little more each time
        if point in (block.falling, block.rising) or (self._line.since + 1) * 20 >= sum(each.number for each in blocks):
            return self._refitted(blocks, device_us)
        line = self._line._replace(since=self._line.since + 1)
        return replace(self, _blocks=blocks, _line=line, _last_us=device_us, _late=0)

    def _refitted(self, blocks: tuple[SampleBlock, ...], device_us: int) -> DeviceClock:
        assert self._line is not None
        max_drift = self.max_drift
        line = fitted(blocks, device_us, self._line.drift, max_drift)
        if line.at_bound and max_drift < LARGEST_DRIFT:
            max_drift = min(5.0 * max_drift, LARGEST_DRIFT)
            line = fitted(blocks, device_us, line.drift, max_drift)
        before, variance = self._line.predict(device_us)
        risen, believed_us = self._risen, self._believed_us
        if before - line.offset > math.sqrt(variance):
            risen = max(0.0, risen - (before - line.offset))
        if believed_us is not None and device_us >= believed_us:
            risen, believed_us = 0.0, None
        raised, until_us = self._raised, self._raised_until_us
        if device_us >= until_us:
            raised = 0.0
        if line.raised >= 0.5 * raised:
            raised, until_us = max(line.raised, raised), device_us + WINDOW_US
        return DeviceClock(
            self.tick_us,
            max_drift,
            self.restarts,
            blocks,
            line,
            device_us,
            self._begun_us,
            _risen=risen,
            _believed_us=believed_us,
            _raised=raised,
            _raised_until_us=until_us,
        )

    def _answer(self, device_us: int, excess: float) -> tuple[DeviceClock, int, float]:
        """Answer for a sample that lies `excess` too high: delayed, or its clock was set back."""
        assert self._line is not None
        offset, variance = self._line.predict(device_us)
        # a time rounded down is early by up to a tick: its mean square
        sigma = math.sqrt(INFLATION**2 * variance + self.tick_us**2 / 3.0 + HOST_US**2)
        begin = BEGIN_DOUBT_US * max(0.0, 1.0 - abs(device_us - self._begun_us) / BEGIN_US)
        # what may be of the way as well as of the clock stands within two deviations of either
        sigma_us = max(sigma, begin, math.hypot(sigma, 0.5 * max(excess, self._raised, self._risen)))
        return self, device_us + round(offset), sigma_us * 1e-6
