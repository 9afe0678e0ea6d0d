"""The stamp of a sample: when it was measured, on the host's clock, and how well that is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from modelserver.messages import NAN, Sample
from msdrivers.device_clock import DeviceClock
from msdrivers.station import Measured, Now


@dataclass(slots=True)
class Stamper:
    """Stamps the samples of one device. `sigma` is that of the last stamp, seconds; nan before the first.

    The device's clock is compared with the host's monotonic one, which nobody sets: where the host's date steps, the
    stamps step with it, and nothing else.
    """

    clock: DeviceClock
    sigma: float = NAN
    _ahead_us: int = 0

    @property
    def offset(self) -> float:
        """Host's clock minus the device's at the last stamp, seconds; nan before the first."""
        return self.clock.offset + self._ahead_us * 1e-6

    def stamp(self, measured: Measured, now: Now) -> Sample:
        """Return the sample with utime and utime_sigma in its header, from the device's time where it has one."""
        header = measured.sample.header
        if header.device_utime:
            tick_us = measured.tick * 1e6
            clock = self.clock if self.clock.tick_us == tick_us else replace(self.clock, tick_us=tick_us)
            self._ahead_us = now.utime - now.monotonic_ns // 1000
            self.clock, instant, sigma = clock.take(header.device_utime, header.host_utime - self._ahead_us)
            utime = instant + self._ahead_us
            self.sigma = math.hypot(sigma, measured.delay_sigma)
        else:
            utime = header.host_utime
            # nothing is known of a delay without deviation
            self.sigma = measured.delay_sigma or NAN
        stamped = replace(header, utime=max(1, utime - round(measured.delay * 1e6)), utime_sigma=self.sigma)
        return replace(measured.sample, header=stamped)
