"""The stamp of a sample, and what the steps of a device's time do to its sigma."""

from __future__ import annotations

import math

import pytest
from support_gx1 import Line, standing

from modelserver.messages import ImuSample, SensorHeader
from msdrivers.device_clock import DeviceClock
from msdrivers.devices.gx1 import Gx1Driver, Gx1Settings
from msdrivers.emulate.gx1 import Gx1Emulator
from msdrivers.emulate.gx1_unit import Eeprom
from msdrivers.stamping import Stamper
from msdrivers.station import Measured

UTIME = 1_700_000_000_000_000


def stamped(tick: float) -> Stamper:
    stamper = Stamper(DeviceClock())
    for n in range(200):
        header = SensorHeader(0, "imu", n, UTIME + n * 10_000, 5_000_000 + n * 10_000)
        stamper.stamp(Measured(ImuSample(header), tick=tick))
    return stamper


@pytest.mark.parametrize("tick", [0.0065536, 0.01])
def test_given_a_time_in_steps_then_sigma_has_their_mean_square(tick: float) -> None:
    fine, coarse = stamped(1e-6), stamped(tick)
    assert coarse.clock.tick_us == pytest.approx(tick * 1e6)
    assert coarse.sigma == pytest.approx(math.hypot(fine.sigma, tick / math.sqrt(3.0)), rel=0.02)


@pytest.mark.parametrize(("hundred_hertz", "tick"), [(True, 0.01), (False, 0.0065536)])
def test_given_an_inertial_unit_then_its_samples_have_the_tick_that_it_told(hundred_hertz: bool, tick: float) -> None:
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(standing(), Eeprom.factory(hundred_hertz=hundred_hertz)))
    line.run(2.0)
    assert len(line.samples) > 100
    assert [measured.tick for measured in line.samples] == pytest.approx([tick] * len(line.samples))
