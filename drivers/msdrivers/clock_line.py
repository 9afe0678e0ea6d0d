"""The line through the lower edge of how the host's clock and a device's differ, with its doubt; see `device_clock`.

For each drift b the envelope touches the lowest sample, the offset lies below that by D / (n + 1) on average for n
delays spread over D, and b itself weighs exp(n * (envelope at the mean time) / D). Averaged over all drifts that gives
offset, drift and their covariance, from the first sample on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

JITTER_US = 20_000.0
JITTER_WEIGHT = 4.0
"""What is thought of the delays before they are seen, and how many samples that thought counts for."""

BEND = 3e-8
"""How fast a drift may change unsaid, a second: a crystal that becomes 10 K warmer within minutes."""

RAISED = 4.0
"""A floor that lies this many times above the line what so many samples lie on average has been raised."""

ENOUGH = 4
"""Fewer samples say nothing of a floor."""

CANDIDATES = 24
"""Drifts that are weighed at a time."""

NEAR_BOUND = 0.95

UNLIKELY = 9.0
"""Drifts whose weight is below exp(-9) of the best one's are left out."""


class Point(NamedTuple):
    """A sample: the device's time, and host minus device time. Microseconds."""

    device: int
    difference: int


class SampleBlock(NamedTuple):
    """Some seconds of samples: the lowest for the least and for the greatest drift, sums over all. Microseconds."""

    start: int
    falling: Point
    rising: Point
    number: int
    devices: int
    differences: int

    @classmethod
    def begun(cls, point: Point, counted: int) -> SampleBlock:
        """Return the block of one sample, whose difference counts in the mean as `counted`."""
        return cls(point.device, point, point, 1, point.device, counted)

    def taken(self, point: Point, counted: int, max_drift: float) -> SampleBlock:
        """Return the block with one sample more."""
        return SampleBlock(
            self.start,
            point if _is_lower(point, self.falling, -max_drift) else self.falling,
            point if _is_lower(point, self.rising, max_drift) else self.rising,
            self.number + 1,
            self.devices + point.device,
            self.differences + counted,
        )


def _is_lower(point: Point, other: Point, drift: float) -> bool:
    return point.difference - other.difference < drift * (point.device - other.device)


class ClockLine(NamedTuple):
    """The line at device time `at`: offset, drift, their covariance (microseconds), the spread of the delays.

    raised: by how much the lower edge of the latest samples lies higher than so many delays explain, microseconds.
    at_bound: the drift that is likeliest is the largest that was allowed.
    since: samples taken since the line was found.
    """

    at: int
    offset: float
    drift: float
    offset_variance: float
    covariance: float
    drift_variance: float
    jitter: float
    raised: float
    at_bound: bool
    since: int = 0

    def predict(self, device_us: int) -> tuple[float, float]:
        """Return offset and its variance at a device time."""
        after = device_us - self.at
        variance = self.offset_variance + after * (2.0 * self.covariance + after * self.drift_variance)
        return self.offset + self.drift * after, max(variance, 0.0)


def fitted(blocks: tuple[SampleBlock, ...], at: int, drift: float, max_drift: float) -> ClockLine:
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
    # a line through a curve that bends so leaves it by this at its end
    span = (blocks[-1].start - blocks[0].start) * 1e-6
    spread = below**2 * count / (count + 2) + (BEND * span**2 / 8.0 * 1e6) ** 2
    raised = _raised(blocks, lows - mean_drift * times - mean_edge, jitter)
    return ClockLine(
        at,
        base + mean_edge - below,
        mean_drift,
        float(weights @ edge_off**2) + spread,
        float(weights @ (edge_off * drift_off)),
        float(weights @ drift_off**2) + 1e-20,
        jitter,
        raised,
        float(weights @ (np.abs(drifts) > NEAR_BOUND * max_drift)) > 0.5,
    )


def _raised(blocks: tuple[SampleBlock, ...], above: np.ndarray, jitter: float) -> float:
    """Return by how much the floor since some block lies too high, for the block where that is most. Microseconds."""
    floors = np.minimum.accumulate(np.minimum(above[0::2], above[1::2])[::-1])
    numbers = np.cumsum([block.number for block in reversed(blocks)])
    is_raised = (floors > RAISED * jitter / (numbers + 1)) & (numbers >= ENOUGH)
    return float(np.max(floors, where=is_raised, initial=0.0))
