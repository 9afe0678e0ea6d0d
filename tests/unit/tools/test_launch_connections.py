"""The lines of the demo: every driver of the vehicle file is led to loopback, and nothing else is changed."""

from __future__ import annotations

from pathlib import Path

from modelserver.config.vehicle_file import load_config
from msdrivers.registry import CanSettings, ModbusSettings, SerialSettings
from mstools.commands.demo import find_vehicle_file
from mstools.commands.driver import load_drivers
from mstools.launch import processes as connections


def test_given_the_vehicle_file_then_all_its_drivers_are_led_to_lines_of_this_machine(tmp_path: Path) -> None:
    lines = connections.make_connections(find_vehicle_file(), tmp_path, own_bus=True)
    vehicle, drivers = load_drivers(lines.vehicle)
    original, before = load_drivers(find_vehicle_file())
    for name in ("gps", "imu", "front_axis"):
        assert drivers[name].device_settings == before[name].device_settings
    assert vehicle.sensors == original.sensors
    assert vehicle.geometry == original.geometry
    assert list(lines.devices) == list(before)
    for name, driver in drivers.items():
        line = driver.line
        options = lines.devices[name]
        if isinstance(line, CanSettings):
            assert line.interface == "udp_multicast"
            assert options == ("--can", line.can)
            assert Path(driver.device_settings.dbc).is_file()
        elif isinstance(line, SerialSettings):
            assert options == ("--pty", "--link", line.port)
            assert Path(line.port).parent == tmp_path
        else:
            assert isinstance(line, ModbusSettings)
            assert line.address == f"127.0.0.1:{options[-1]}"
    # the wheels and the controller are on one bus, which is not LCM's
    buses = {driver.line.can for driver in drivers.values() if isinstance(driver.line, CanSettings)}
    assert len(buses) == 1
    assert lines.url.split("?")[0].rpartition(":")[2] != buses.pop().rpartition(":")[2]


def test_given_the_raptor_then_its_drivers_are_as_the_vehicle_file_reports() -> None:
    _, drivers = load_drivers(find_vehicle_file())
    kinds = {name: driver.kind.name for name, driver in drivers.items()}
    assert kinds == {"gps": "novatel", "imu": "gx1", "wheels": "wheels", "raptor": "vehicle", "front_axis": "axis"}
    sensors = load_config(find_vehicle_file()).sensors
    assert sensors.wheels is not None
    assert set(drivers["wheels"].device_settings.wheels) == set(sensors.wheels.frames)
