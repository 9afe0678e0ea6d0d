"""`modelserver driver` and `emulate` before they connect: rejected options and their messages."""

from __future__ import annotations

import logging
import math
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import lcm
import pytest
from support_formats import YAML

from modelserver.config.vehicle_file import load_config
from modelserver.errors import ModelServerError
from modelserver.messages import FixType, GpsSample, SensorHeader
from modelserver.wire.codec import encode
from mstools.cli import main
from mstools.commands.driver import DriveOptions, load_driver, log_end, samples_of, warn_of_names

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


def test_given_a_name_with_nothing_after_it_then_driver_and_list_report_it(run: Callable[..., Output]) -> None:
    for words in (("driver", "later"), ("driver", "--list"), ("emulate", "later", "--pty")):
        code, _, err = run(*words)
        assert code == 1
        assert "vehicle.yaml:8: error: drivers.later is empty: device is missing" in err


def test_given_list_then_drivers_stand_beside_what_is_wrong_with_them(
    run: Callable[..., Output], vehicle: Path
) -> None:
    vehicle.write_text(VEHICLE.replace("  later:\n", ""))
    code, out, err = run("driver", "--list")
    assert code == 0
    assert "imu              gx1: MicroStrain" in out
    assert "warning: the geometry has no constraint 'CameraFixd'" in err


def test_given_a_driver_of_a_mistyped_joint_then_it_warns(vehicle: Path, caplog: pytest.LogCaptureFixture) -> None:
    warn_of_names(*load_driver("axis", vehicle))
    assert "vehicle.yaml:12 (drivers.axis.joint): the geometry has no constraint 'CameraFixd'" in caplog.text
    assert "write CameraFixed" in caplog.text
    caplog.clear()
    warn_of_names(*load_driver("gps", vehicle))
    assert not caplog.text


def test_given_a_log_for_what_goes_where_it_is_reported_then_it_is_wrong_usage(run: Callable[..., Output]) -> None:
    code, _, err = run("emulate", "axis", "--tcp", "0", "--from", "drive.lcm")
    assert code == 2
    assert "device axis follows its commands and cannot replay a log" in err


def make_options(log: Path | None = None, start: int | None = None, seconds: float = 60.0) -> DriveOptions:
    return DriveOptions(log, start, seconds, "eight", 1, (0.0, 0.0, 0.0))


@pytest.fixture
def raptor(tmp_path: Path) -> Path:
    for name in ("vehicle.yaml", "geometry.yaml", "raptor.dbc"):
        shutil.copy(RAPTOR / name, tmp_path)
    return tmp_path / "vehicle.yaml"


def test_given_a_drive_that_is_over_then_it_is_reported_before_a_line_is_opened(raptor: Path) -> None:
    with pytest.raises(ModelServerError, match=r"--start 1 is \d+ s ago, and the drive lasts 60 s: it is over"):
        samples_of(*load_driver("gps", raptor), make_options(start=1))
    # it does not drive along
    assert list(samples_of(*load_driver("front_axis", raptor), make_options(start=1))) == []


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "drive.lcm"
    events = lcm.EventLog(str(path), "w", overwrite=True)
    for n in range(3):
        utime = 1_700_000_000_000_000 + n * 50_000
        fix = GpsSample(SensorHeader(utime, "gps", n, utime), FixType.FIX_3D, 50.0, -111.0 + n, height_msl=math.nan)
        events.write_event(utime, "GPS", encode(fix))
    events.close()
    return path


def test_given_a_log_then_its_end_is_reported(raptor: Path, log: Path, caplog: pytest.LogCaptureFixture) -> None:
    samples = samples_of(*load_driver("gps", raptor), make_options(log))
    assert not caplog.text
    assert [sample.longitude_deg for sample in samples if isinstance(sample, GpsSample)] == [-111.0, -110.0, -109.0]
    assert f"gps: {log} is over, there are no more measurements" in caplog.text


def test_given_a_log_without_the_channel_or_of_long_ago_then_it_is_an_error_at_once(raptor: Path, log: Path) -> None:
    with pytest.raises(ModelServerError, match="has no messages on IMU"):
        samples_of(*load_driver("imu", raptor), make_options(log))
    with pytest.raises(ModelServerError, match=r"--start 1 is so long ago that .*drive.lcm is over"):
        samples_of(*load_driver("gps", raptor), make_options(log, start=1))
    soon = time.time_ns() // 1000 + 3_600_000_000
    assert len(list(samples_of(*load_driver("gps", raptor), make_options(log, start=soon)))) == 3


def test_given_the_raptor_then_its_drivers_have_no_error() -> None:
    from mstools.commands.driver import constraints_of, find_driver_problems

    path = RAPTOR / "vehicle.yaml"
    config = load_config(path)
    found = find_driver_problems(config, str(path), constraints_of(config))
    assert [each for each in found if each.element != "drivers.front_axis.joint"] == []


def test_given_samples_that_end_then_it_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    samples = log_end(iter(()), "gps", "the simulated drive")
    assert list(samples) == []
    assert list(samples) == []
    assert [record.message for record in caplog.records] == [
        "gps: the simulated drive is over, there are no more measurements"
    ]
