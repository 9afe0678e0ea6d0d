"""The Husky recording: imported, replayed and scored against its own fixes."""

from __future__ import annotations

import collections
import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from support_recordings import HUSKY

from benchmarks import protocols
from modelserver.config.vehicle_file import load_config
from modelserver.server.recordings import OfflineRun
from modelserver.server.vehicle import load_vehicle
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogFile
from mstools.recordings.bag_log import ImportReport, import_bag

pytestmark = pytest.mark.realdata

ANTENNA = "Antenna:PhaseCenter"


@pytest.fixture(scope="session")
def husky_log(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ImportReport]:
    log = tmp_path_factory.mktemp("husky") / "test1.lcm"
    return log, import_bag(data_dir / "husky" / "test1.bag", log)


@pytest.fixture(scope="session")
def antenna(husky_log: tuple[Path, ImportReport]) -> npt.NDArray[np.float64]:
    """Time (s from the first event), east, north, up, valid: the antenna at 10 Hz."""
    vehicle = load_vehicle(load_config(HUSKY))
    with LogFile(husky_log[0]) as log:
        run = OfflineRun(vehicle, log, ANTENNA)
        rows = [(each.utime, each.easting, each.northing, each.up, each.valid) for each in run.rows(None, 10.0)]
        start = run.first_utime
    found = np.array(rows, float)
    found[:, 0] = (found[:, 0] - start) * 1e-6
    return found


def test_given_the_bag_when_imported_then_every_message_is_in_the_log(husky_log: tuple[Path, ImportReport]) -> None:
    log, report = husky_log
    assert {each.topic: (each.channel, each.written) for each in report.topics} == {
        "/fix": ("GPS", 989),
        "/imu/data": ("IMU", 11865),
        "/husky_velocity_controller/odom": ("WHEELS", 3952),
    }
    with LogFile(log) as recording:
        counts = collections.Counter(each.channel for each in recording)
        assert recording.damage == []
    assert counts == {"GPS": 989, "IMU": 11865, "WHEELS": 3952}
    assert report.seconds == pytest.approx(395.3, abs=0.1)
    assert "by gravity it is enu" in report.to_text()


def test_given_the_bag_when_imported_then_the_units_are_right(husky_log: tuple[Path, ImportReport]) -> None:
    with LogFile(husky_log[0]) as recording:
        events = list(recording)
    imu = [decode("imu_t", each.data) for each in events if each.channel == "IMU"]
    force = np.mean([each.specific_force for each in imu], axis=0)
    assert force[1] == pytest.approx(9.8, abs=0.3)  # up is the unit's y axis: the mount in config/husky rests on it
    assert np.hypot(force[0], force[2]) < 1.0
    gps = [decode("gps_t", each.data) for each in events if each.channel == "GPS"]
    # the geoid lies 28 m below the ellipsoid there and the car park some meters above the sea
    assert -30.0 < np.median([each.height_ellipsoidal for each in gps]) < -15.0
    wheels = [decode("wheels_t", each.data) for each in events if each.channel == "WHEELS"]
    way = np.mean([wheel.travel for wheel in wheels[-1].wheels])
    assert way == pytest.approx(358.8, abs=0.5)
    turned = np.subtract(*(wheel.travel for wheel in reversed(wheels[-1].wheels))) / 0.555
    assert turned == pytest.approx(-3.46, abs=0.02)  # the same as the odometry's own yaw, end minus start


def test_given_the_recording_when_replayed_then_the_pose_is_valid_although_fixes_wander(
    antenna: npt.NDArray[np.float64],
) -> None:
    # its fixes move 5 m aside within 7 s, while it drives straight ahead: after two minutes dead reckoning is 16 m from
    # them, and for half a minute either may be beyond the limit of 20 m
    valid = antenna[np.argmax(antenna[:, 4] > 0) :, 4] > 0
    assert antenna[np.argmax(antenna[:, 4] > 0), 0] < 12.0
    assert valid.mean() > 0.9
    # at 10 Hz
    assert max(map(len, "".join("v" if each else "i" for each in valid).split("v"))) < 350


def test_given_the_recording_when_replayed_then_the_antenna_follows_its_fixes_within_their_noise(
    husky_log: tuple[Path, ImportReport], antenna: npt.NDArray[np.float64]
) -> None:
    with LogFile(husky_log[0]) as recording:
        fixes = protocols.read_fixes(recording)
    t = (fixes.utime - fixes.utime[0]) * 1e-6 + antenna[0, 0]
    known = antenna[np.argmax(antenna[:, 4] > 0) :]
    scored = (t > known[0, 0] + 1.0) & (t < known[-1, 0])
    place = np.column_stack([np.interp(t[scored], known[:, 0], known[:, k]) for k in (1, 2)])
    off = np.hypot(*(place - fixes.positions[scored]).T)
    # the receiver states 0.9 m on each axis: 1.27 m horizontally, one standard deviation
    assert np.sqrt((off**2).mean()) < 0.9
    assert (off < 2 * 1.27).mean() > 0.99


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # the scorer leaves a file open
def test_given_withheld_fixes_when_replayed_then_the_path_between_fixes_is_propagated_better_than_by_holding(
    husky_log: tuple[Path, ImportReport], data_dir: Path
) -> None:
    if protocols.load_scorer(data_dir) is None:
        pytest.skip(f"no scorer beside {data_dir}")
    ours = protocols.run(protocols.ReplayJob(husky_log[0], HUSKY, data_dir, "half"))
    with LogFile(husky_log[0]) as recording:
        fixes = protocols.read_fixes(recording)
    k = np.flatnonzero(fixes.withheld & (fixes.utime - fixes.utime[0] >= protocols.SKIP_S * 1e6))
    held = np.hypot(*(fixes.positions[k] - fixes.positions[k - 1]).T)
    assert ours.missing == 0
    assert ours.n > 450
    assert ours.rmse < np.sqrt((held**2).mean())


def test_given_the_recording_when_replayed_twice_then_the_same_bits(husky_log: tuple[Path, ImportReport]) -> None:
    vehicle = load_vehicle(load_config(HUSKY))

    def lines() -> list[str]:
        with LogFile(husky_log[0]) as log:
            first_minute = itertools.islice(log, 2500)
            return [each.to_csv() for each in OfflineRun(vehicle, first_minute, ANTENNA).rows(None, 20.0)]

    assert lines() == lines()


def test_given_the_page_on_recordings_then_its_example_is_what_comes_out(husky_log: tuple[Path, ImportReport]) -> None:
    page = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text(encoding="utf-8")
    (shown,) = [line for line in page.splitlines() if line.startswith("14322")]
    with LogFile(husky_log[0]) as log:
        run = OfflineRun(load_vehicle(load_config(HUSKY)), log, "Husky:Base")
        row = next(run.rows([int(shown.partition(",")[0])]))
    # the page leaves out the last columns
    assert row.to_csv().startswith(shown.removesuffix("…"))
