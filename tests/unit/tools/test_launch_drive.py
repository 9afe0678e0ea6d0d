"""Emulated devices with one start time are on one drive: each sample comes at its stamp."""

from __future__ import annotations

from itertools import islice

import pytest

from modelserver.config.vehicle_file import load_config
from modelserver.messages import GpsSample, WheelsSample
from msdrivers.devices.can import parse_dbc
from msdrivers.emulate.vehicle import WheelsEmulator
from msdrivers.endpoint import HostTime
from mstools.commands.demo import find_vehicle_file
from mstools.commands.driver import load_driver
from mstools.launch.drive import make_simulation

START = 1_750_000_000_000_000


def test_given_one_start_then_the_truth_does_not_depend_on_sensor_length_or_seed() -> None:
    vehicle = load_config(find_vehicle_file())
    one = make_simulation(vehicle, START, 10.0, sensors=(GpsSample,), seed=3)
    other = make_simulation(vehicle, START, 80.0, sensors=(WheelsSample,), seed=4)
    for seconds in (0.0, 4.0, 9.5):
        utime = START + round(seconds * 1e6)
        assert one.truth(utime).enu.is_close(other.truth(utime).enu)
    assert {type(sample) for sample in islice(one.events(9.0), 20)} == {GpsSample}


@pytest.mark.parametrize("ahead_us", [2_000_000, 0, -500_000])
def test_given_a_drive_that_begins_later_then_the_wheels_wait_for_it_and_else_begin_at_once(ahead_us: int) -> None:
    _, settings = load_driver("wheels", find_vehicle_file())
    vehicle = load_config(find_vehicle_file())
    dbc = find_vehicle_file().parent / settings.device_settings.dbc
    samples = make_simulation(vehicle, START, 10.0, sensors=(WheelsSample,)).events(10.0)
    first, *_ = wheels = [sample for sample in islice(samples, 5) if isinstance(sample, WheelsSample)]
    emulator = WheelsEmulator(
        settings.device_settings.wheels, parse_dbc(dbc.read_text(encoding="utf-8"), str(dbc)), wheels
    )
    now = HostTime(7_000_000_000, first.header.utime - ahead_us)
    emulator.on_open(now)
    # one that is past is due at once
    assert emulator.get_deadline() == now.monotonic_ns + ahead_us * 1000
