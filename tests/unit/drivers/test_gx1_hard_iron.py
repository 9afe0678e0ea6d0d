"""The hard-iron procedure of the 3DM-GX1, with an emulated device that has iron of its own."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support_gx1 import FIELD_NED, START_UTIME, Line, RepeatingDevice, rotating_samples, stationary_samples

from modelserver.messages import ImuSample, SensorHeader
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3
from msdrivers.devices.gx1.driver import Gx1Driver
from msdrivers.devices.gx1.hard_iron import HardIronProcedure, HardIronSettings
from msdrivers.devices.gx1.settings import Gx1Settings
from msdrivers.emulate.faults import InjectedFault
from msdrivers.emulate.gx1 import Eeprom, Gx1Emulator, Gx1Unit
from msdrivers.endpoint import EndpointPhase
from msdrivers.protocol.gx1 import CommandByte, EepromAddress, Gx1Packet

IRON: Vector3 = (12e-6, -7e-6, 5e-6)
OLD = (100, -200, 300)
MAGNITUDE_Z = round(FIELD_NED[2] / 1e-4 * 32_768_000 / 2000)


def tumbling(seconds: float) -> Iterator[ImuSample]:
    """Yield samples of a magnetometer that is turned about all its axes."""
    for k in range(round(seconds * 20)):
        t = k / 20
        q = so3.from_rpy(2.1 * t, 1.3 * t, 0.7 * t)
        field = so3.rotate(so3.conjugate(q), FIELD_NED)
        yield ImuSample(SensorHeader(START_UTIME + round(t * 1e6)), magnetic_field=field, orientation=q)


def device_with(samples: Iterator[ImuSample], *faults: InjectedFault, streams: int = 0) -> Gx1Emulator:
    old = Eeprom.make_factory().write(dict(zip(EepromAddress.HARD_IRON, OLD, strict=True)))
    return Gx1Emulator(samples, old, Gx1Unit(field_offset=IRON, faults=faults, streamed_at_start=streams))


def read_offsets(device: Gx1Emulator) -> tuple[int, ...]:
    return tuple((device.eeprom.read_word(address) + 32768) % 65536 - 32768 for address in EepromAddress.HARD_IRON)


def test_given_turns_about_all_axes_then_the_devices_own_field_is_found_stored_and_removed():
    device = device_with(tumbling(100.0))
    procedure = HardIronProcedure(HardIronSettings(duration=60.0, two_dimensional=False))
    line = Line(procedure, device)
    line.run(66.0)
    result = procedure.result
    assert result is not None
    assert result.is_stored
    assert result.offsets == pytest.approx(IRON, abs=1.0e-6)
    assert result.spans == pytest.approx((106e-6,) * 3, rel=0.05)
    assert "are stored and were read back" in line.status_texts()[-1]
    assert read_offsets(device) == pytest.approx([axis / 1e-4 * 16384 for axis in IRON], abs=160)
    progress = [text for text in line.status_texts(EndpointPhase.CONFIGURING) if "field spans" in text]
    assert len(progress) in (10, 11)
    assert "5 of 60 s" in progress[0]
    # the memory outlives the device that was switched off: its field is the earth's now
    restored = Gx1Emulator(stationary_samples(), device.eeprom, device.unit)
    driver = Line(Gx1Driver(Gx1Settings("imu", CommandByte.QUATERNION_VECTORS)), restored)
    driver.run(3.0)
    assert driver.samples[-1].sample.magnetic_field == pytest.approx(FIELD_NED, abs=1.0e-6)


def test_given_full_turns_on_level_ground_then_the_offsets_of_x_and_y_are_found():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 60.0))
    procedure = HardIronProcedure(HardIronSettings(duration=30.0, magnitude_z=MAGNITUDE_Z))
    Line(procedure, device).run(40.0)
    assert procedure.result is not None
    assert procedure.result.is_stored
    assert procedure.result.offsets == pytest.approx(IRON, abs=0.2e-6)


def test_given_a_vehicle_that_is_not_turned_then_nothing_is_stored_and_the_reason_is_reported():
    device = device_with(stationary_samples(60.0))
    procedure = HardIronProcedure(HardIronSettings(duration=10.0))
    line = Line(procedure, device)
    line.run(20.0)
    assert procedure.result is not None
    assert not procedure.result.is_stored
    assert procedure.result.offsets is None
    assert "the field along x changed by 0.0 uT, and at least 15.0 uT are needed" in procedure.result.text
    assert "the offsets are as they were before" in procedure.result.text
    assert read_offsets(device) == OLD


def test_given_turns_on_level_ground_only_when_all_axes_are_asked_for_then_z_is_rejected():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 60.0))
    procedure = HardIronProcedure(HardIronSettings(duration=30.0, two_dimensional=False))
    Line(procedure, device).run(40.0)
    assert procedure.result is not None
    assert "the field along z changed by 0.0 uT" in procedure.result.text
    assert read_offsets(device) == OLD


def test_given_a_device_that_stalls_amid_the_turns_then_the_offsets_are_written_back():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 60.0), InjectedFault(10.0, "stall", 2.5))
    procedure = HardIronProcedure(HardIronSettings(duration=30.0))
    line = Line(procedure, device)
    line.run(40.0)
    assert procedure.result is not None
    assert "request 'hard iron collect' was sent 3 times and not answered" in procedure.result.text
    assert not procedure.result.is_stored
    assert read_offsets(device) == OLD


def test_given_a_device_that_is_gone_when_offsets_are_written_back_then_it_is_reported():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 60.0), InjectedFault(10.0, "stall", 100.0))
    procedure = HardIronProcedure(HardIronSettings(duration=30.0))
    Line(procedure, device).run(40.0)
    assert procedure.result is not None
    assert "could not be restored" in procedure.result.text
    assert "[100, -200, 300] counts" in procedure.result.text


def test_given_an_interruption_then_the_offsets_and_the_stream_are_as_they_were_found():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 60.0), streams=CommandByte.STABILIZED_EULER)
    procedure = HardIronProcedure(HardIronSettings(duration=30.0))
    line = Line(procedure, device)
    line.run(10.0)
    assert read_offsets(device) == (0, 0, 0)
    assert device.streamed == 0
    line.close()
    assert read_offsets(device) == OLD
    assert device.streamed == CommandByte.STABILIZED_EULER
    assert any("interrupted, the offsets from before are written back" in text for text in line.status_texts())


def test_given_a_procedure_that_is_done_then_what_was_streamed_is_streamed_again_and_leaving_does_nothing():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 60.0), streams=CommandByte.STABILIZED_EULER)
    procedure = HardIronProcedure(HardIronSettings(duration=30.0))
    line = Line(procedure, device)
    line.run(40.0)
    assert device.streamed == CommandByte.STABILIZED_EULER
    assert procedure.on_close(line.now()) == []
    assert procedure.get_deadline() is None
    assert procedure.on_open(line.now()) == []


def test_given_the_line_lost_amid_the_turns_then_it_begins_again_and_the_first_offsets_are_restored_on_failure():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 90.0))
    procedure = HardIronProcedure(HardIronSettings(duration=30.0))
    line = Line(procedure, device)
    line.run(10.0)
    line._from_host(procedure.on_open(line.now()))
    line.run(5.0)
    line.close()
    assert read_offsets(device) == OLD


def test_given_offsets_that_the_memory_did_not_take_then_the_procedure_has_failed():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 60.0))
    procedure = HardIronProcedure(HardIronSettings(duration=20.0))
    line = Line(procedure, device)

    def forgetful(unit: bytes) -> bytes:
        if unit[0] == CommandByte.HARD_IRON_COMPUTE:
            device.eeprom = device.eeprom.write(dict(zip(EepromAddress.HARD_IRON, (7, 7, 7), strict=True)))
        return unit

    line.corrupt = forgetful
    line.run(30.0)
    assert procedure.result is not None
    assert "its EEPROM (address 172) holds 7: it was not stored" in procedure.result.text
    assert read_offsets(device) == OLD


def test_given_offsets_that_are_not_the_middle_of_the_extremes_then_the_procedure_has_failed():
    device = device_with(rotating_samples((0.0, 0.0, 0.5), 60.0))
    procedure = HardIronProcedure(HardIronSettings(duration=20.0))
    line = Line(procedure, device)

    def wrong(unit: bytes) -> bytes:
        if unit[0] != CommandByte.HARD_IRON_COMPUTE:
            return unit
        device.eeprom = device.eeprom.write(dict(zip(EepromAddress.HARD_IRON, (7, 7, 7), strict=True)))
        return Gx1Packet(CommandByte.HARD_IRON_COMPUTE, (7, 7, 7), int.from_bytes(unit[7:9], "big")).to_bytes()

    line.corrupt = wrong
    line.run(30.0)
    assert procedure.result is not None
    assert "offset along x is 7 counts, but the middle of its extremes is 1966" in procedure.result.text
    assert read_offsets(device) == OLD


def test_given_a_magnet_beside_the_device_then_it_is_reported():
    unit = Gx1Unit(field_offset=(195e-6, 0.0, 0.0))
    procedure = HardIronProcedure(HardIronSettings(duration=20.0))
    Line(procedure, Gx1Emulator(rotating_samples((0.0, 0.0, 0.5), 60.0), unit=unit)).run(30.0)
    assert procedure.result is not None
    assert "the field is stronger than the device can measure" in procedure.result.text


def test_given_nobody_on_the_port_then_it_is_reported_and_there_is_no_result():
    procedure = HardIronProcedure(HardIronSettings())
    line = Line(procedure, RepeatingDevice(b""))
    line.run(20.0)
    assert "no 3DM-GX1 answers on this line" in line.status_texts(EndpointPhase.SILENT)[0]
    assert procedure.result is None
    assert procedure.on_close(line.now()) == []


def test_given_gains_of_zero_then_it_is_reported_that_it_cannot_begin():
    device = Gx1Emulator(stationary_samples(), Eeprom())
    procedure = HardIronProcedure(HardIronSettings())
    line = Line(procedure, device)
    line.run(6.0)
    assert (
        "hard iron: cannot begin: the gyro gain in its EEPROM (address 130) is 0"
        in line.status_texts(EndpointPhase.SILENT)[0]
    )


@pytest.mark.parametrize("change", [{"period": 0.0}, {"duration": 0.05}, {"bauds": (0,)}])
def test_given_settings_without_sense_then_they_are_rejected(change):
    with pytest.raises(ValueError, match=f"^{'bauds' if 'bauds' in change else 'period'}: "):
        HardIronSettings(**change)
