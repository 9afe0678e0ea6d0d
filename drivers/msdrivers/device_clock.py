"""The instant of a measurement from a device's clock: offset and drift against the host's clock, and their doubt.

A sample is measured at the device's time and received later by a delay that varies: host minus device time is the
offset of the two clocks plus that delay. The delay is never negative, so the offset is the lower envelope of the
differences, a line whose slope is the drift (Moon, Skelly and Towsley, "Estimation and removal of clock skew from
network delay measurements", INFOCOM 1999). Here the line is not only found but averaged over all that the samples
allow: for each drift b the envelope touches the lowest sample, the offset lies below that by D / (n + 1) on average
for n delays spread over D, and b itself weighs exp(n * (envelope at the mean time) / D). That gives the offset's
standard deviation with it, from the first sample on.

The shortest delay of the way itself cannot be told from an offset: it is configured, not estimated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

BLOCK_US = 2_000_000
WINDOW_US = 120_000_000
"""The envelope is kept for two minutes, as the lowest samples of every two seconds: drifts change slowly, but do."""

JITTER_US = 20_000.0
JITTER_WEIGHT = 4.0
"""What is thought of the delays before they are seen, and how many samples that thought counts for."""

SLACK_US = 5_000.0
"""By how much a sample must leave the band of the delays before the clocks are suspected."""

LATE_SAMPLES = 8
LATE_US = 1_000_000
"""A sample that is too late is taken for delayed, until so many in a row have been, for so long on the host's clock."""

LOST_US = 60_000_000
"""No delay is so long: a clock has stepped."""

CLIP = 3.0
"""A delay counts as at most this many times the usual spread, so that one long stall does not widen it."""

HOST_US = 50.0
"""What the host's own stamp is good for, standard deviation."""

INFLATION = 1.4
"""On the standard deviation: the doubt is one-sided, and within two deviations of it lie 95 % only just."""

CANDIDATES = 24
"""Drifts that are weighed at a time."""

UNLIKELY = 9.0
"""Drifts whose weight is below exp(-9) of the best one's are left out."""


class _Point(NamedTuple):
    """A sample: the device's time, and host minus device time. Microseconds."""

    device: int
    difference: int


class _Block(NamedTuple):
    """Two seconds of samples: the lowest for the least and for the greatest drift, and sums over all. Microseconds."""

    start: int
    falling: _Point
    rising: _Point
    number: int
    devices: int
    differences: int

    def taken(self, point: _Point, counted: int, max_drift: float) -> _Block:
        """Return the block with one sample more, whose difference counts in the mean as `counted`."""
        return _Block(
            self.start,
            point if _is_lower(point, self.falling, -max_drift) else self.falling,
            point if _is_lower(point, self.rising, max_drift) else self.rising,
            self.number + 1,
            self.devices + point.device,
            self.differences + counted,
        )


def _is_lower(point: _Point, other: _Point, drift: float) -> bool:
    return point.difference - other.difference < drift * (point.device - other.device)


class _Fit(NamedTuple):
    """The line at device time `at`: offset, drift, their covariance (microseconds), the spread of the delays.

    since: samples taken since it was found.
    """

    at: int
    offset: float
    drift: float
    offset_variance: float
    covariance: float
    drift_variance: float
    jitter: float
    since: int = 0

    def predict(self, device_us: int) -> tuple[float, float]:
        """Return offset and its variance at a device time."""
        after = device_us - self.at
        variance = self.offset_variance + after * (2.0 * self.covariance + after * self.drift_variance)
        return self.offset + self.drift * after, max(variance, 0.0)


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """What is known of a device's clock. Every sample gives a new one; cost and size are bounded.

    tick_us: the device's time goes in steps so long, rounded down. max_drift: no clock is off by more, as a fraction.
    restarts: how often a clock was seen to step.
    """

    tick_us: float = 1.0
    max_drift: float = 200e-6
    restarts: int = 0
    _blocks: tuple[_Block, ...] = ()
    _fit: _Fit | None = None
    _last_us: int | None = None
    _late: int = 0
    _late_since_us: int = 0

    @property
    def offset(self) -> float:
        """Host minus device time at the last sample, seconds; nan before the first."""
        if self._fit is None or self._last_us is None:
            return math.nan
        return self._fit.predict(self._last_us)[0] * 1e-6

    @property
    def drift(self) -> float:
        """How much faster the host's clock runs than the device's, as a fraction; nan before the first sample."""
        return math.nan if self._fit is None else self._fit.drift

    def take(self, device_us: int, host_us: int) -> tuple[DeviceClock, int, float]:
        """Take a sample; return the clock after it, the sample's instant on the host's clock, and its sigma.

        `device_us` is the device's time without wraps, `host_us` when the host received it: microseconds. The instant
        is in microseconds too, its standard deviation in seconds.
        """
        difference = host_us - device_us
        if self._fit is None:
            return self._restarted(device_us, difference, self.restarts)
        offset, variance = self._fit.predict(device_us)
        excess = difference - offset
        slack = SLACK_US + self.tick_us + self._fit.jitter + 3.0 * math.sqrt(variance)
        if excess < -slack or excess > LOST_US:
            return self._restarted(device_us, difference, self.restarts + 1)
        if excess > slack:
            since = self._late_since_us if self._late else host_us
            late = self._late + 1
            if late >= LATE_SAMPLES and host_us - since >= LATE_US:
                return self._restarted(device_us, difference, self.restarts + 1)
            clock = replace(self, _late=late, _late_since_us=since, _last_us=device_us)
            # late, or its clock has stepped: both stand within two deviations
            return clock._answer(device_us, 0.5 * excess)
        clock = self
        if device_us != self._last_us:
            counted = min(difference, round(offset + CLIP * self._fit.jitter))
            clock = self._absorbed(device_us, difference, counted)
        elif self._late:
            clock = replace(self, _late=0)
        return clock._answer(device_us, 0.0)

    def _restarted(self, device_us: int, difference: int, restarts: int) -> tuple[DeviceClock, int, float]:
        block = _begun(_Point(device_us, difference), difference)
        fit = _fitted((block,), device_us, 0.0, self.max_drift)
        clock = replace(self, restarts=restarts, _blocks=(block,), _fit=fit, _last_us=device_us, _late=0)
        return clock._answer(device_us, 0.0)

    def _absorbed(self, device_us: int, difference: int, counted: int) -> DeviceClock:
        assert self._fit is not None
        last, point = self._blocks[-1], _Point(device_us, difference)
        if device_us - last.start >= BLOCK_US:
            block = _begun(point, counted)
            recent = (each for each in self._blocks if abs(device_us - each.start) < WINDOW_US)
            blocks = (*recent, block)
        else:
            block = last.taken(point, counted, self.max_drift)
            blocks = (*self._blocks[:-1], block)
        lower = point in (block.falling, block.rising)
        fit = self._fit
        # a sample above the envelope changes only how many there were, which tells little more each time
        if lower or (fit.since + 1) * 20 >= sum(each.number for each in blocks):
            fit = _fitted(blocks, device_us, fit.drift, self.max_drift)
        else:
            fit = fit._replace(since=fit.since + 1)
        return replace(self, _blocks=blocks, _fit=fit, _last_us=device_us, _late=0)

    def _answer(self, device_us: int, doubt_us: float) -> tuple[DeviceClock, int, float]:
        assert self._fit is not None
        offset, variance = self._fit.predict(device_us)
        # a time rounded down is early by up to a tick: its mean square
        sigma_us = math.sqrt(INFLATION**2 * variance + self.tick_us**2 / 3.0 + HOST_US**2)
        return self, device_us + round(offset), max(sigma_us, doubt_us) * 1e-6


def _begun(point: _Point, counted: int) -> _Block:
    return _Block(point.device, point, point, 1, point.device, counted)


def _fitted(blocks: tuple[_Block, ...], at: int, drift: float, max_drift: float) -> _Fit:
    """Return the line through the lower edge of the blocks at device time `at`; `drift` is a first guess."""
    points = [point for block in blocks for point in block[1:3]]
    base = points[-1].difference
    times = np.array([point.device - at for point in points], float)
    lows = np.array([point.difference - base for point in points], float)
    count = sum(block.number for block in blocks)
    mean_time = sum(block.devices - block.number * at for block in blocks) / count
    mean = sum(block.differences - block.number * base for block in blocks) / count

    # the mean of delays spread evenly over D is D / 2, that of the least of n D / (n + 1)
    above = max(0.0, mean - drift * mean_time - float(np.min(lows - drift * times)))
    jitter = (JITTER_WEIGHT * JITTER_US + 2.0 * count * above) / (JITTER_WEIGHT + count - 1)

    low, high = -max_drift, max_drift
    while True:
        drifts = np.linspace(low, high, CANDIDATES)
        edges = np.min(lows[None, :] - drifts[:, None] * times[None, :], axis=1)
        weights = count * (edges + drifts * mean_time) / jitter
        weights -= weights.max()
        likely = np.flatnonzero(weights > -UNLIKELY)
        step = (high - low) / (CANDIDATES - 1)
        if len(likely) > CANDIDATES // 3 or step < 1e-10:
            break
        low, high = max(low, drifts[likely[0]] - step), min(high, drifts[likely[-1]] + step)
    weights = np.exp(weights)
    weights /= weights.sum()
    below = jitter / (count + 1)
    mean_drift, mean_edge = float(weights @ drifts), float(weights @ edges)
    edge_off, drift_off = edges - mean_edge, drifts - mean_drift
    spread = below**2 * count / (count + 2)
    return _Fit(
        at,
        base + mean_edge - below,
        mean_drift,
        float(weights @ edge_off**2) + spread,
        float(weights @ (edge_off * drift_off)),
        float(weights @ drift_off**2) + 1e-20,
        jitter,
    )
