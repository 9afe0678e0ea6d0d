"""`modelserver driver` and `emulate` before they connect: rejected options and their messages."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support_formats import YAML

from modelserver.config.vehicle_file import load_config
from modelserver.errors import ModelServerError
from mstools.cli import main
from mstools.commands.driver import load_driver, simulate

RAPTOR = Path(__file__).parents[3] / "config" / "raptor"

VEHICLE = """\
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Mast
drivers:
  gps: {device: novatel, port: /dev/nowhere}
  nmea: {device: nmea, port: /dev/nowhere2}
  imu: {device: gx1, port: /dev/nowhere3}
  later:
  axis:
    device: axis
    address: "127.0.0.1:5020"
    joint: CameraFixd
    registers: {angle: {address: 0, scale_deg: 0.01}}
"""

Output = tuple[int, str, str]


@pytest.fixture
def vehicle(tmp_path: Path) -> Path:
    (tmp_path / "geometry.yaml").write_text(YAML)
    path = tmp_path / "vehicle.yaml"
    path.write_text(VEHICLE)
    return path


@pytest.fixture
def run(vehicle: Path, capsys: pytest.CaptureFixture[str]) -> Iterator[Callable[..., Output]]:
    """Return a function that runs a command on the vehicle file, and gives exit code, output and errors."""

    def command(*words: str) -> Output:
        with pytest.raises(SystemExit) as ended:
            main([*words, "-c", str(vehicle)])
        out, err = capsys.readouterr()
        return int(ended.value.code or 0), out, err

    handlers = logging.root.handlers[:]
    yield command
    # what the command has set up for its own process
    logging.root.handlers[:] = handlers


def test_given_the_recording_of_another_device_then_it_is_refused_with_whose_it_is(
    run: Callable[..., Output], tmp_path: Path
) -> None:
    raw = tmp_path / "gps.raw"
    raw.write_text("# modelserver raw 1 bytes gps novatel\n< 1 2 00\n")
    for name, kind in (("imu", "gx1"), ("nmea", "nmea"), ("axis", "axis")):
        code, _, err = run("driver", name, "--play-raw", str(raw))
        assert code == 1
        assert f"{raw}: recording of a novatel (driver gps), but driver {name} is a {kind}" in err


def test_given_the_vehicle_file_to_record_into_then_it_stays(run: Callable[..., Output], vehicle: Path) -> None:
    code, _, err = run("driver", "gps", "--record-raw", str(vehicle))
    assert code == 1
    assert "vehicle.yaml is there already, and stays; name another" in err
    assert vehicle.read_text() == VEHICLE


def test_given_a_name_with_nothing_after_it_then_driver_and_emulate_report_it(run: Callable[..., Output]) -> None:
    for words in (("driver", "later"), ("emulate", "later", "--pty")):
        code, _, err = run(*words)
        assert code == 1
        assert "vehicle.yaml:8: error: drivers.later is empty: device is missing" in err


def test_given_a_drive_that_ends_then_it_is_reported_once(raptor: Path, caplog: pytest.LogCaptureFixture) -> None:
    samples = simulate(*load_driver("gps", raptor), seconds=1.0)
    assert len(list(samples)) == pytest.approx(4, abs=1)
    assert list(samples) == []
    assert [record.message for record in caplog.records] == [
        "gps: the simulated drive is over, there are no more measurements"
    ]


@pytest.fixture
def raptor(tmp_path: Path) -> Path:
    for name in ("vehicle.yaml", "geometry.yaml", "raptor.dbc"):
        shutil.copy(RAPTOR / name, tmp_path)
    return tmp_path / "vehicle.yaml"


def test_given_a_drive_that_is_over_then_it_is_reported_before_a_line_is_opened(raptor: Path) -> None:
    with pytest.raises(ModelServerError, match=r"--start 1 is \d+ s ago, and the drive lasts 60 s: it is over"):
        list(simulate(*load_driver("gps", raptor), start=1, seconds=60.0))
    # it does not drive along
    assert list(simulate(*load_driver("front_axis", raptor), start=1, seconds=60.0)) == []


def test_given_the_raptor_then_its_drivers_have_no_error() -> None:
    from modelserver.formats import examine_file
    from mstools.commands.driver import find_driver_problems

    path = RAPTOR / "vehicle.yaml"
    config = load_config(path)
    found = find_driver_problems(config, str(path), examine_file(config.geometry, config.variables).constraints)
    assert [each for each in found if each.element != "drivers.front_axis.joint"] == []
