"""The memory of an emulated inertial unit in a file."""

from __future__ import annotations

from pathlib import Path

import pytest
from support_gx1 import Line, stationary_samples

from modelserver.errors import ModelServerError
from msdrivers.devices.gx1.settings import Gx1Settings
from msdrivers.emulate.gx1 import Eeprom, Gx1Emulator
from msdrivers.endpoint import HostTime
from msdrivers.gx1_eeprom_file import read_eeprom, write_eeprom
from msdrivers.protocol.gx1 import EepromAddress, requests
from msdrivers.registry import KINDS, EmulatorInputs


def test_given_no_file_then_the_memory_is_that_of_a_new_device(tmp_path: Path) -> None:
    assert read_eeprom(tmp_path / "none") == Eeprom.make_factory()


def test_given_a_memory_when_written_and_read_then_it_is_the_same(tmp_path: Path) -> None:
    path = tmp_path / "imu.eeprom"
    eeprom = Eeprom.make_factory().write({0: 65535, 254: 1, 172: -5})
    write_eeprom(path, eeprom)
    assert read_eeprom(path) == eeprom
    assert [each.name for each in tmp_path.iterdir()] == ["imu.eeprom"]


@pytest.mark.parametrize("text", ["1 5", "256 5", "0 65536", "0", "0 1 2", "0 -1", "zero 1", "\u0661 1"])
def test_given_a_file_that_is_no_memory_then_the_line_is_reported(tmp_path: Path, text: str) -> None:
    path = tmp_path / "imu.eeprom"
    path.write_text(f"0 1\n{text}\n", encoding="utf-8")
    with pytest.raises(ModelServerError, match=r"line 2: .* is no EEPROM word"):
        read_eeprom(path)


def test_given_a_device_that_must_persist_a_word_then_the_next_emulator_has_it(tmp_path: Path) -> None:
    kind, path = KINDS["gx1"], tmp_path / "imu.eeprom"
    assert kind.has_memory
    emulation = EmulatorInputs(Gx1Settings("imu"), tmp_path, stationary_samples(1.0), memory_file=path)
    device = kind.make_emulator(emulation)
    device.on_open(HostTime(0, 1))
    device.on_receive(requests.make_write_eeprom(EepromAddress.HARD_IRON[1], -77), HostTime(1, 1))
    again = kind.make_emulator(emulation)
    assert isinstance(again, Gx1Emulator)
    assert again.eeprom.read_word(EepromAddress.HARD_IRON[1]) == 65536 - 77


def test_given_a_known_device_when_the_line_is_reopened_then_it_streams_within_a_second() -> None:
    driver = KINDS["gx1"].load().make_driver(Gx1Settings("imu"), Path())
    line = Line(driver, Gx1Emulator(stationary_samples()))
    line.run(3.0)
    # as after the cable was out: the device has streamed on
    line._from_host(driver.on_open(line.now()))
    line.samples.clear()
    line.run(1.0)
    assert len(line.samples) > 20
    # and as after it was without power: it does not stream
    line.device = Gx1Emulator(stationary_samples())
    line._from_device(line.device.on_open(line.now()))
    line._from_host(driver.on_open(line.now()))
    line.samples.clear()
    line.run(1.0)
    assert len(line.samples) > 40
