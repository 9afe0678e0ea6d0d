"""Time stamps from a device's clock: clock offset and clock drift against the monotonic clock of the host, and sigmas.

A device measures at its own time t_d; the host receives the sample at t_h = t_d + offset(t_d) + delay with delay >= 0.
The offset is therefore the lower envelope of t_h - t_d, a line whose slope is the drift (Moon, Skelly and Towsley,
"Estimation and removal of clock skew from network delay measurements", INFOCOM 1999).

Fit (`fit_lower_envelope`): for each candidate drift b the envelope touches the lowest sample. With n delays spread
uniformly over D (the jitter) the offset lies D / (n + 1) below the envelope on average, and the likelihood of b is
exp(n * (envelope at the mean time) / D). The average over all b gives offset, drift and their covariance from the
first sample on. Blocks of 2 s keep the lowest samples of the last 120 s, so cost and memory are bounded.

Step detection (`DeviceClock.update`): a sample far below the line, or a second of samples far above it, means that one
clock stepped; the fit restarts and `restarts` counts. After the line was opened again, the first sample shows it.

Limits: the minimum delay cannot be observed; it is configured (`delay`). A delay that grows for good cannot be
distinguished from a device clock that was set back; half the difference is added to sigma: for one more window while
the fit still follows it, until samples arrive as early as before where the fit restarted, and for one window where the
step is half a second or more, because no transport delay is that long.

`Stamper` applies the clock to the samples of one device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from modelserver.messages import NAN, Sample
from msdrivers.endpoint import HostTime, MeasuredSample

PRIOR_JITTER_US = 20_000.0
PRIOR_JITTER_WEIGHT = 4.0
"""Prior of the jitter, and its weight in samples."""

DRIFT_RATE = 3e-8
"""Random change of the drift per second: a crystal that warms by 10 K within minutes."""

STEP_THRESHOLD = 4.0
"""The lowest of n samples lies D / (n + 1) above the line on average; this many times that is a step."""

MIN_STEP_SAMPLES = 4
"""Fewer samples do not determine a minimum."""

DRIFT_CANDIDATES = 24
"""Drifts evaluated in each refinement of the grid."""

BOUND_MARGIN = 0.95

MIN_LOG_WEIGHT = 9.0
"""The grid is narrowed to drifts whose weight is above exp(-9) of the best."""


class ClockOffsetSample(NamedTuple):
    """Device time and host minus device time, microseconds."""

    device: int
    offset: int


class SampleBlock(NamedTuple):
    """Two seconds of samples: the lowest for the smallest and for the largest drift, and sums. Microseconds."""

    start: int
    lowest_falling: ClockOffsetSample
    lowest_rising: ClockOffsetSample
    samples: int
    device_sum: int
    offset_sum: int

    def add(self, point: ClockOffsetSample, clipped: int, max_drift: float) -> SampleBlock:
        """Return the block with one more sample; `clipped` is its offset as it enters the mean."""
        return SampleBlock(
            self.start,
            point if _is_lower(point, self.lowest_falling, -max_drift) else self.lowest_falling,
            point if _is_lower(point, self.lowest_rising, max_drift) else self.lowest_rising,
            self.samples + 1,
            self.device_sum + point.device,
            self.offset_sum + clipped,
        )


def _start_block(point: ClockOffsetSample, clipped: int) -> SampleBlock:
    return SampleBlock(point.device, point, point, 1, point.device, clipped)


def _is_lower(point: ClockOffsetSample, other: ClockOffsetSample, drift: float) -> bool:
    return point.offset - other.offset < drift * (point.device - other.device)


class ClockFit(NamedTuple):
    """Linear clock model at device time `reference`. Microseconds.

    jitter: spread of the delays. step: how far the lower edge of the latest samples lies above what the jitter
    explains. is_at_bound: the most likely drift is the largest allowed.
    """

    reference: int
    offset: float
    drift: float
    offset_variance: float
    covariance: float
    drift_variance: float
    jitter: float
    step: float
    is_at_bound: bool
    samples_since_fit: int = 0

    def predict(self, device_us: int) -> tuple[float, float]:
        """Predict the offset and its variance at a device time."""
        after = device_us - self.reference
        variance = self.offset_variance + after * (2.0 * self.covariance + after * self.drift_variance)
        return self.offset + self.drift * after, max(variance, 0.0)


def fit_lower_envelope(blocks: tuple[SampleBlock, ...], at: int, drift: float, max_drift: float) -> ClockFit:
    """Fit the lower envelope of the blocks at device time `at`; `drift` is the first guess of the slope."""
    points = [point for block in blocks for point in block[1:3]]
    base = points[-1].offset
    times = np.array([point.device - at for point in points], float)
    lows = np.array([point.offset - base for point in points], float)
    count = sum(block.samples for block in blocks)
    mean_time = sum(block.device_sum - block.samples * at for block in blocks) / count
    mean = sum(block.offset_sum - block.samples * base for block in blocks) / count

    # the mean of delays uniform over D is D / 2, the mean of the smallest of n is D / (n + 1)
    above = max(0.0, mean - drift * mean_time - float(np.min(lows - drift * times)))
    jitter = (PRIOR_JITTER_WEIGHT * PRIOR_JITTER_US + 2.0 * count * above) / (PRIOR_JITTER_WEIGHT + count - 1)

    low, high = -max_drift, max_drift
    while True:
        drifts = np.linspace(low, high, DRIFT_CANDIDATES)
        edges = np.min(lows[None, :] - drifts[:, None] * times[None, :], axis=1)
        weights = count * (edges + drifts * mean_time) / jitter
        weights -= weights.max()
        likely = np.flatnonzero(weights > -MIN_LOG_WEIGHT)
        step = (high - low) / (DRIFT_CANDIDATES - 1)
        if len(likely) > DRIFT_CANDIDATES // 3 or step < 1e-10:
            break
        low, high = max(low, drifts[likely[0]] - step), min(high, drifts[likely[-1]] + step)
    weights = np.exp(weights)
    weights /= weights.sum()
    below = jitter / (count + 1)
    mean_drift, mean_edge = float(weights @ drifts), float(weights @ edges)
    edge_off, drift_off = edges - mean_edge, drifts - mean_drift
    # deviation of a line from a curve with this bend at its end
    span = (blocks[-1].start - blocks[0].start) * 1e-6
    spread = below**2 * count / (count + 2) + (DRIFT_RATE * span**2 / 8.0 * 1e6) ** 2
    raised = _estimate_step(blocks, lows - mean_drift * times - mean_edge, jitter)
    return ClockFit(
        at,
        base + mean_edge - below,
        mean_drift,
        float(weights @ edge_off**2) + spread,
        float(weights @ (edge_off * drift_off)),
        float(weights @ drift_off**2) + 1e-20,
        jitter,
        raised,
        float(weights @ (np.abs(drifts) > BOUND_MARGIN * max_drift)) > 0.5,
    )


def _estimate_step(blocks: tuple[SampleBlock, ...], above: np.ndarray, jitter: float) -> float:
    """Return the largest amount by which the minimum since some block is too high. Microseconds."""
    floors = np.minimum.accumulate(np.minimum(above[0::2], above[1::2])[::-1])
    numbers = np.cumsum([block.samples for block in reversed(blocks)])
    is_raised = (floors > STEP_THRESHOLD * jitter / (numbers + 1)) & (numbers >= MIN_STEP_SAMPLES)
    return float(np.max(floors, where=is_raised, initial=0.0))


BLOCK_US = 2_000_000
WINDOW_US = 120_000_000
"""Length of a block and of the window of blocks: drifts change slowly."""

MAX_DRIFT = 1e-2
"""Beyond any crystal; a tick whose length is configured wrongly may be off by this much."""

SLACK_US = 5_000.0
"""Margin around the band of delays before a clock step is suspected."""

MIN_DELAYED_SAMPLES = 8
MIN_DELAYED_US = 1_000_000
"""A late sample counts as delayed until this many in a row were late, over this long on the host's clock."""

MAX_DELAY_US = 60_000_000
"""No delay is longer; a clock has stepped."""

STEP_US = 500_000.0
"""A delay that grows by this much for good is a clock step, e.g. of a receiver that learns the leap seconds."""

STARTUP_US = 1_000_000
STARTUP_SIGMA_US = 150_000.0
"""In the first second all samples may have been delayed: an extra sigma falls from this to zero."""

JITTER_CLIP = 3.0
"""Delays enter the jitter clipped at this multiple, so that one long stall does not inflate it."""

HOST_SIGMA_US = 50.0
"""Standard deviation of the host's own stamp."""

INFLATION = 1.4
"""Inflation of the standard deviation: the error is one-sided and its two-sigma coverage only just 95 %."""


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """Immutable estimator of a device's clock; each update returns a new one of bounded size.

    tick_us: resolution of the device's time, which is rounded down. max_drift: largest drift as a fraction, enlarged
    when the samples demand it. restarts: detected clock steps.
    """

    tick_us: float = 1.0
    max_drift: float = 200e-6
    restarts: int = 0
    _blocks: tuple[SampleBlock, ...] = ()
    _fit: ClockFit | None = None
    _last_us: int | None = None
    _started_us: int = 0
    _delayed_count: int = 0
    _delayed_since_us: int = 0
    _step_us: float = 0.0
    """Error of the restarted fit if the delay grew instead of the clock stepping, microseconds."""
    _step_until_us: int | None = None
    """Device time after which that possibility is dropped."""
    _edge_step_us: float = 0.0
    _edge_step_until_us: int = 0
    """Largest recent step of the lower edge above the line."""
    _is_reconnected: bool = False
    """Whether the line was opened again since the last sample: a large excess is then no delay, but another start."""

    @property
    def offset(self) -> float:
        """Host minus device time at the last sample, seconds; nan before the first."""
        if self._fit is None or self._last_us is None:
            return math.nan
        return self._fit.predict(self._last_us)[0] * 1e-6

    @property
    def drift(self) -> float:
        """Rate of the host's clock relative to the device's, minus 1; nan before the first sample."""
        return math.nan if self._fit is None else self._fit.drift

    def reconnect(self) -> DeviceClock:
        """Return the clock after the line was opened again: the device may have been switched off meanwhile."""
        return replace(self, _is_reconnected=True)

    def update(self, device_us: int, host_us: int) -> tuple[DeviceClock, int, float]:
        """Process a sample; return the updated clock and when it was measured: host's microseconds, sigma in seconds.

        `device_us`: the device's time without wraps. `host_us`: receive time on the host's monotonic clock.
        """
        if self._is_reconnected:
            # no delay lasts as long as a line was closed
            return replace(self, _is_reconnected=False)._update(device_us, host_us, STEP_US)
        return self._update(device_us, host_us, MAX_DELAY_US)

    def _update(self, device_us: int, host_us: int, max_delay_us: float) -> tuple[DeviceClock, int, float]:
        difference = host_us - device_us
        if self._fit is None:
            return self._restart(device_us, difference, 0.0)
        offset, variance = self._fit.predict(device_us)
        excess = difference - offset
        usual = self.tick_us + self._fit.jitter + 3.0 * math.sqrt(variance)
        if excess > max_delay_us:
            return self._restart(device_us, difference, 0.0)
        if excess < -usual - SLACK_US:
            return self._restart(device_us, difference, self._step_us + excess)
        if excess > usual + SLACK_US:
            since = self._delayed_since_us if self._delayed_count else host_us
            late = self._delayed_count + 1
            if late >= MIN_DELAYED_SAMPLES and host_us - since >= MIN_DELAYED_US:
                return self._restart(device_us, difference, self._step_us + excess)
            clock = replace(self, _delayed_count=late, _delayed_since_us=since, _last_us=device_us)
            return clock._estimate(device_us, excess)
        clock = self
        if device_us != self._last_us:
            clipped = min(difference, round(offset + JITTER_CLIP * self._fit.jitter))
            clock = self._add_sample(device_us, difference, clipped)
        elif self._delayed_count:
            clock = replace(self, _delayed_count=0)
        return clock._estimate(device_us, excess if excess > JITTER_CLIP * usual else 0.0)

    def _restart(self, device_us: int, difference: int, step_us: float) -> tuple[DeviceClock, int, float]:
        block = _start_block(ClockOffsetSample(device_us, difference), difference)
        clock = replace(
            self,
            restarts=self.restarts + (self._fit is not None),
            _blocks=(block,),
            _fit=fit_lower_envelope((block,), device_us, 0.0, self.max_drift),
            _last_us=device_us,
            _started_us=device_us,
            _delayed_count=0,
            _edge_step_us=0.0,
            _step_us=max(0.0, step_us),
            _step_until_us=device_us + WINDOW_US if step_us >= STEP_US else None,
        )
        return clock._estimate(device_us, 0.0)

    def _add_sample(self, device_us: int, difference: int, clipped: int) -> DeviceClock:
        assert self._fit is not None
        last, point = self._blocks[-1], ClockOffsetSample(device_us, difference)
        if device_us - last.start >= BLOCK_US:
            block = _start_block(point, clipped)
            recent = (each for each in self._blocks if abs(device_us - each.start) < WINDOW_US)
            blocks = (*recent, block)
        else:
            block = last.add(point, clipped, self.max_drift)
            blocks = (*self._blocks[:-1], block)
        # a sample above the envelope changes only the count: refit after 5 % more
        if point in (block.lowest_falling, block.lowest_rising) or (self._fit.samples_since_fit + 1) * 20 >= sum(
            each.samples for each in blocks
        ):
            return self._refit(blocks, device_us)
        line = self._fit._replace(samples_since_fit=self._fit.samples_since_fit + 1)
        return replace(self, _blocks=blocks, _fit=line, _last_us=device_us, _delayed_count=0)

    def _refit(self, blocks: tuple[SampleBlock, ...], device_us: int) -> DeviceClock:
        assert self._fit is not None
        max_drift = self.max_drift
        line = fit_lower_envelope(blocks, device_us, self._fit.drift, max_drift)
        if line.is_at_bound and max_drift < MAX_DRIFT:
            max_drift = min(5.0 * max_drift, MAX_DRIFT)
            line = fit_lower_envelope(blocks, device_us, line.drift, max_drift)
        before, variance = self._fit.predict(device_us)
        step_us, step_until_us = self._step_us, self._step_until_us
        if before - line.offset > math.sqrt(variance):
            step_us = max(0.0, step_us - (before - line.offset))
        if step_until_us is not None and device_us >= step_until_us:
            step_us, step_until_us = 0.0, None
        edge_us, edge_until_us = self._edge_step_us, self._edge_step_until_us
        if device_us >= edge_until_us:
            edge_us = 0.0
        if line.step >= 0.5 * edge_us:
            edge_us, edge_until_us = max(line.step, edge_us), device_us + WINDOW_US
        return replace(
            self,
            max_drift=max_drift,
            _blocks=blocks,
            _fit=line,
            _last_us=device_us,
            _delayed_count=0,
            _step_us=step_us,
            _step_until_us=step_until_us,
            _edge_step_us=edge_us,
            _edge_step_until_us=edge_until_us,
        )

    def _estimate(self, device_us: int, excess: float) -> tuple[DeviceClock, int, float]:
        """Estimate instant and sigma of a sample `excess` above the line: delayed, or its clock was set back."""
        assert self._fit is not None
        offset, variance = self._fit.predict(device_us)
        # mean square of the error of a time rounded down to a tick
        sigma = math.sqrt(INFLATION**2 * variance + self.tick_us**2 / 3.0 + HOST_SIGMA_US**2)
        startup = STARTUP_SIGMA_US * max(0.0, 1.0 - abs(device_us - self._started_us) / STARTUP_US)
        # an ambiguity between delay and clock lies within two sigma of both
        sigma_us = max(sigma, startup, math.hypot(sigma, 0.5 * max(excess, self._edge_step_us, self._step_us)))
        return self, device_us + round(offset), sigma_us * 1e-6


@dataclass(slots=True)
class Stamper:
    """Stamps the samples of one device; `sigma` is that of the last stamp in seconds, nan before the first.

    The device's clock is compared with the host's monotonic clock, which is never set: when the host's date steps, the
    stamps step with it and the fit is not disturbed.
    """

    clock: DeviceClock
    sigma: float = NAN
    _utc_minus_monotonic_us: int = 0

    @property
    def offset(self) -> float:
        """Host's UTC minus the device's time at the last stamp, seconds; nan before the first."""
        return self.clock.offset + self._utc_minus_monotonic_us * 1e-6

    def reconnect(self) -> None:
        """Expect another start of the device: its line was opened again."""
        self.clock = self.clock.reconnect()

    def stamp(self, measured: MeasuredSample, now: HostTime) -> Sample:
        """Fill in utime and utime_sigma: from the device's time if the sample has one, else from the receive time."""
        header = measured.sample.header
        if header.device_utime:
            tick_us = measured.tick * 1e6
            clock = self.clock if self.clock.tick_us == tick_us else replace(self.clock, tick_us=tick_us)
            self._utc_minus_monotonic_us = now.utime - now.monotonic_ns // 1000
            self.clock, instant, sigma = clock.update(
                header.device_utime, header.host_utime - self._utc_minus_monotonic_us
            )
            utime = instant + self._utc_minus_monotonic_us
            self.sigma = math.hypot(sigma, measured.delay_sigma)
        else:
            utime = header.host_utime
            # without delay_sigma the uncertainty is unknown
            self.sigma = measured.delay_sigma or NAN
        stamped = replace(header, utime=max(1, utime - round(measured.delay * 1e6)), utime_sigma=self.sigma)
        return replace(measured.sample, header=stamped)
