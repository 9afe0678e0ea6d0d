"""From a device that measures to the stamp of its sample, with a way between that delays: emulator, driver, runner."""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Iterator, Sequence

import pytest
from support_gx1 import START_UTIME, rotating_samples

from modelserver.messages import FixType, GpsSample, ImuSample, Sample, SensorHeader
from msdrivers.devices.gps.driver import GpsDriver, GpsSettings
from msdrivers.devices.gx1 import Gx1Driver, Gx1Settings
from msdrivers.emulate.gps import GpsEmulator, GpsUnit
from msdrivers.emulate.imu import Gx1Emulator, Gx1Unit
from msdrivers.endpoint import Endpoint, Output, Send
from msdrivers.links.fake import FakeTimeSource
from msdrivers.runner import Runner, RunnerSettings

WAY_S = 0.02
"""The longest that a unit is under way."""


class DelayedLine:
    """A line with a device at its end, on which every unit takes a time from 0 to `WAY_S`, and none overtakes."""

    description = "delayed"
    baud = 38400

    def __init__(self, device: Endpoint[bytes], time: FakeTimeSource, seed: int):
        self._device, self._time = device, time
        self._rng = random.Random(seed)
        self._coming: deque[tuple[int, bytes]] = deque()

    def open(self, baud: int | None = None) -> None:
        self._take(self._device.on_open(self._time.now()))

    def close(self) -> None:
        pass

    def send(self, unit: bytes) -> None:
        self._take(self._device.on_receive(unit, self._time.now()))

    def poll(self, timeout: float) -> Sequence[bytes]:
        until = self._time.monotonic_ns + round(timeout * 1e9)
        while True:
            due = self._device.get_deadline()
            arrival = self._coming[0][0] if self._coming else until
            at = min(until, arrival, until if due is None else due)
            self._time.sleep(max(0, at - self._time.monotonic_ns) * 1e-9)
            if self._coming and self._coming[0][0] <= self._time.monotonic_ns:
                return (self._coming.popleft()[1],)
            if due is not None and due <= self._time.monotonic_ns:
                self._take(self._device.on_timer(self._time.now()))
            elif self._time.monotonic_ns >= until:
                return ()

    def _take(self, outputs: Sequence[Output[bytes]]) -> None:
        for output in outputs:
            if isinstance(output, Send):
                at = self._time.monotonic_ns + round(self._rng.uniform(0.0, WAY_S) * 1e9)
                self._coming.append((max(at, self._coming[-1][0] if self._coming else 0), output.unit))


def run_driver(driver: Endpoint[bytes], device: Endpoint[bytes], seed: int, seconds: float) -> list[Sample]:
    time = FakeTimeSource(START_UTIME)
    samples: list[Sample] = []
    line = DelayedLine(device, time, seed)
    runner = Runner(driver, line, RunnerSettings("some", "device"), time, samples.append, rng=random.Random(seed))
    end = time.monotonic_ns + round(seconds * 1e9)
    while time.monotonic_ns < end:
        runner.run_once()
    return samples


def fixes(seconds: float, rate_hz: float) -> Iterator[GpsSample]:
    """Yield fixes whose height is the number of the fix."""
    for n in range(round(seconds * rate_hz)):
        utime = START_UTIME + round((n + 1) / rate_hz * 1e6)
        yield GpsSample(
            SensorHeader(utime, "truth", n), FixType.FIX_3D, 50.0, -111.0, height_msl=float(n), velocity=(1.0, 0.0, 0.0)
        )


def check(errors: list[tuple[float, float, float]]) -> None:
    """Check errors and sigmas, seconds, each with the seconds since the first sample."""
    late = sorted(abs(error) for at, error, _ in errors if at >= 5.0)
    assert late[int(0.95 * len(late))] < 2e-3
    covered = sum(abs(error) <= 2.0 * sigma for _, error, sigma in errors)
    assert covered >= 0.95 * len(errors)


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [4.0, 20.0])
def test_given_a_way_of_0_to_20_ms_then_a_fix_is_stamped_within_2_ms_and_its_sigma_covers_it(rate_hz: float) -> None:
    errors = []
    for seed in range(4):
        seconds = 40.0 if rate_hz < 10.0 else 15.0
        device = GpsEmulator(fixes(seconds, rate_hz), GpsUnit(latency=0.0))
        samples = run_driver(GpsDriver(GpsSettings("gps", rate_hz=rate_hz)), device, seed, seconds)
        assert len(samples) > 0.9 * (seconds - 1.0) * rate_hz
        first = samples[0].header.utime
        for sample in samples:
            assert isinstance(sample, GpsSample)
            truth = START_UTIME + (round(sample.height_msl) + 1) / rate_hz * 1e6
            header = sample.header
            errors.append(((header.utime - first) * 1e-6, (header.utime - truth) * 1e-6, header.utime_sigma))
    check(errors)


@pytest.mark.slow
@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_given_a_way_of_0_to_20_ms_then_an_inertial_sample_is_stamped_within_2_ms_and_its_sigma_covers_it(
    drift: float,
) -> None:
    errors = []
    for seed in range(2):
        rate = 0.2
        device = Gx1Emulator(rotating_samples((0.0, 0.0, rate), 12.0), unit=Gx1Unit(delay=0.0, drift=drift))
        samples = run_driver(Gx1Driver(Gx1Settings("imu")), device, seed, 11.5)
        assert len(samples) > 1000
        first = samples[0].header.utime
        for sample in samples:
            assert isinstance(sample, ImuSample)
            assert sample.orientation is not None
            w, _, _, z = sample.orientation
            # it turns steadily: its angle gives the instant, to half a step of its angle
            truth = START_UTIME + 2.0 * math.atan2(z, w) / rate * 1e6
            header = sample.header
            errors.append(((header.utime - first) * 1e-6, (header.utime - truth) * 1e-6, header.utime_sigma))
    check(errors)
