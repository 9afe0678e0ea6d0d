"""The recordings that the accuracy table rests on: converted with the right units, signs and times."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline
from support_recordings import HUSKY

from benchmarks import accuracy, protocols
from benchmarks.protocols import FixTable, load_scorer, read_fixes
from benchmarks.recordings import dresden, husky, kitti, plaza
from modelserver.config.vehicle_file import load_config
from modelserver.estimation.filter.stream_correlation import StreamCorrelation
from modelserver.formats import load_model
from modelserver.messages import Direction, FixType, GpsSample, ImuSample, Mode, WheelsSample
from modelserver.server.vehicle import load_vehicle
from modelserver.wire.codec import decode
from modelserver.wire.eventlog import LogEvent, LogFile

pytestmark = pytest.mark.realdata

Array = npt.NDArray[np.float64]
STEP = 0.02


@dataclass(frozen=True)
class Drive:
    """A converted recording: samples by channel, and their series on an even grid of times."""

    events: list[LogEvent]
    gps: list[GpsSample]
    imu: list[ImuSample]

    @property
    def gps_t(self) -> Array:
        return np.array([each.header.utime - self.imu[0].header.utime for each in self.gps]) * 1e-6

    @property
    def imu_t(self) -> Array:
        return np.array([each.header.utime - self.imu[0].header.utime for each in self.imu]) * 1e-6

    @property
    def grid(self) -> Array:
        return np.arange(self.gps_t[1] + 3.0, self.gps_t[-1] - 3.0, STEP)

    def of_imu(self, key: str, axis: int) -> Array:
        values = [getattr(each, key)[axis] for each in self.imu]
        return smooth(np.interp(self.grid, self.imu_t, values))

    def motion(self) -> tuple[Array, Array, Array]:
        """Speed, its change, and the turning of the course to the left, from positions."""
        place = read_fixes(self.events).positions
        # one fix a second needs a curve between them, ten a second with steps of 0.1 m a line
        seldom = np.median(np.diff(self.gps_t)) > 0.5
        kind = CubicSpline if seldom else lambda t, values: lambda at: np.interp(at, t, values)
        east, north = (kind(self.gps_t, place[:, k])(self.grid) for k in (0, 1))
        ve, vn = rate(east), rate(north)
        speed = np.hypot(ve, vn)
        return speed, rate(speed), rate(np.unwrap(np.arctan2(vn, ve)))


def smooth(values: Array) -> Array:
    return np.convolve(np.pad(values, 12, "edge"), np.ones(25) / 25, "valid")


def rate(values: Array) -> Array:
    return smooth(np.gradient(smooth(values), STEP))


def correlation(a: Array, b: Array, where: npt.NDArray[np.bool_]) -> float:
    return float(np.corrcoef(a[where], b[where])[0, 1])


def read(convert: Callable[[Path, Path], object], files: Iterator[Path], data: Path, log: Path) -> Drive:
    for file in files:
        if not file.is_file():
            pytest.skip(f"no {file.relative_to(data)} among the recordings")
    convert(data, log)
    with LogFile(log) as recording:
        events = list(recording)
    return Drive(
        events,
        [decode("gps_t", each.data) for each in events if each.channel == "GPS"],
        [decode("imu_t", each.data) for each in events if each.channel == "IMU"],
    )


@pytest.fixture(scope="module")
def kitti_drive(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    log = tmp_path_factory.mktemp("kitti") / "log"
    return read(kitti.convert, iter(kitti.files(data_dir)), data_dir, log)


@pytest.fixture(scope="module")
def dresden_drive(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    log = tmp_path_factory.mktemp("dresden") / "log"
    return read(dresden.convert, iter([dresden.file(data_dir)]), data_dir, log)


@pytest.mark.parametrize("recording", accuracy.RECORDINGS, ids=lambda each: each.name)
def test_given_a_healthy_recording_then_no_stream_contradicts_another(
    recording: accuracy.Recording, data_dir: Path, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    recording.convert(data_dir, log)
    vehicle = load_vehicle(load_config(recording.vehicle))
    prepared = vehicle.make_localizer_setup()
    assert prepared is not None
    streams, settled = StreamCorrelation(), 0
    with LogFile(log) as events:
        for event in events:
            if event.channel not in ("GPS", "IMU", "WHEELS"):
                continue
            sample: Any = decode(f"{event.channel.lower()}_t", event.data)
            streams = streams.update(prepared.setup, Mode.FULL, sample)
            assert streams.find_contradictions(has_gyro=True, has_heading=True) == ()
            if streams.is_settled:
                streams, settled = StreamCorrelation(), settled + 1
    assert settled >= 5


def test_given_kitti_when_converted_then_every_row_is_there_and_distances_are_the_files(
    kitti_drive: Drive, data_dir: Path
) -> None:
    table = np.loadtxt(kitti.files(data_dir)[1], delimiter=",", skiprows=1)
    assert (len(kitti_drive.imu), len(kitti_drive.gps)) == (46968, 470)
    assert np.median(np.diff(kitti_drive.imu_t)) == pytest.approx(0.01, abs=1e-4)
    assert np.median(np.diff(kitti_drive.gps_t)) == pytest.approx(1.0, abs=1e-3)
    assert np.diff(kitti_drive.imu_t)[0] == pytest.approx(1.9196, abs=1e-3)
    steps = np.hypot(*np.diff(read_fixes(kitti_drive.events).positions, axis=0).T)
    # UTM shrinks by 0.04 % there
    assert steps.sum() == pytest.approx(np.hypot(*np.diff(table[:, 1:3], axis=0).T).sum(), rel=5e-4)
    heights = np.array([each.height_ellipsoidal for each in kitti_drive.gps])
    assert np.abs(heights - heights[0] - (table[:, 3] - table[0, 3])).max() < 0.2  # the Earth's curve over the drive


def test_given_kitti_when_converted_then_its_axes_are_forward_left_up(kitti_drive: Drive) -> None:
    force = np.mean([each.specific_force for each in kitti_drive.imu], axis=0)
    assert force == pytest.approx([0.0, 0.0, 9.8], abs=0.4)
    speed, gain, turning = kitti_drive.motion()
    moving = speed > 3.0
    assert correlation(kitti_drive.of_imu("angular_velocity", 2), turning, moving) > 0.9
    assert correlation(kitti_drive.of_imu("specific_force", 0), gain, moving) > 0.8
    assert correlation(kitti_drive.of_imu("specific_force", 1), speed * turning, moving) > 0.8


def test_given_dresden_when_converted_then_the_rates_and_fixes_are_as_the_file_has_them(dresden_drive: Drive) -> None:
    assert len(dresden_drive.imu) == 10800
    assert 2000 < len(dresden_drive.gps) < 2200
    assert np.median(np.diff(dresden_drive.imu_t)) == pytest.approx(0.02, abs=1e-3)
    assert np.median(np.diff(dresden_drive.gps_t)) == pytest.approx(0.1, abs=5e-3)
    assert {each.fix_type for each in dresden_drive.gps} == {FixType.FIX_3D}
    sigmas = np.sqrt([each.position_covariance[0] for each in dresden_drive.gps if each.position_covariance])
    assert len(sigmas) == len(dresden_drive.gps)
    assert 1.5 < sigmas.min() < sigmas.max() < 6.0
    assert all(each.header.host_utime - each.header.utime == 500_000 for each in dresden_drive.gps)
    # the receiver's clock, beside the computer's
    ahead = [each.header.device_utime - each.header.host_utime for each in dresden_drive.gps]
    assert abs(np.median(ahead)) < 0.5e6


def test_given_dresden_when_converted_then_its_axes_are_forward_left_up(dresden_drive: Drive) -> None:
    force = np.mean([each.specific_force for each in dresden_drive.imu], axis=0)
    assert np.linalg.norm(force) == pytest.approx(9.8, abs=0.1)
    assert force[2] > 9.0
    vehicle = accuracy.RECORDINGS[2].vehicle
    model = load_model(load_config(vehicle).geometry)
    mount = model.get_transformation("Imu:Origin", "Car:Base").pose
    tilt = mount.transform(tuple(force))
    assert math.hypot(tilt[0], tilt[1]) < 0.1  # with the mount in its geometry the mean force points up

    place = dresden_drive.motion()[0]
    # speed and course hold for an instant before the position's
    later = dresden_drive.gps_t - dresden.VELOCITY_LATENCY
    speed = smooth(np.interp(dresden_drive.grid, later, [each.speed for each in dresden_drive.gps]))
    course = np.interp(dresden_drive.grid, later, np.unwrap([each.course for each in dresden_drive.gps]))
    moving = (speed > 2.0) & (place > 1.0)
    turning = rate(course)
    assert correlation(speed, place, moving) > 0.9
    assert correlation(dresden_drive.of_imu("angular_velocity", 2), turning, moving) > 0.7
    assert correlation(dresden_drive.of_imu("specific_force", 0), rate(speed), moving) > 0.7
    assert correlation(dresden_drive.of_imu("specific_force", 1), speed * turning, moving) > 0.5


def test_given_dresden_when_converted_then_the_course_is_the_way_of_the_positions(dresden_drive: Drive) -> None:
    fixes = read_fixes(dresden_drive.events)
    ve, vn = np.gradient(fixes.positions[:, 0]), np.gradient(fixes.positions[:, 1])
    way = np.arctan2(smooth(vn), smooth(ve))
    t = dresden_drive.gps_t
    course = np.interp(t, t - dresden.VELOCITY_LATENCY, np.unwrap([each.course for each in dresden_drive.gps]))
    speed = np.array([each.speed for each in dresden_drive.gps])
    off = np.array([math.remainder(value, math.tau) for value in (way - course)[speed > 3.0]])
    assert abs(np.median(off)) < math.radians(3.0)
    assert np.median(np.abs(off)) < math.radians(10.0)


@pytest.mark.parametrize(("name", "rest"), [("plaza1", 2.8e-5), ("plaza2", -7.0e-3)])
def test_given_plaza_when_converted_then_its_wheels_turn_as_its_gyro(
    name: str, rest: float, data_dir: Path, tmp_path: Path
) -> None:
    if not all(path.is_file() for path in plaza.files(data_dir, name)):
        pytest.skip(f"no {name} among the recordings")
    increments, ranges = plaza.read(data_dir, name)
    assert (np.diff(ranges[:, 0]) >= 0).all()
    standing = increments[:, 1] < 0.002
    # what goes on turning while the vehicle stands is a gyro's bias, no encoder's
    assert increments[standing, 2].mean() / np.median(np.diff(increments[:, 0])) == pytest.approx(rest, abs=2e-4)

    where = plaza.Beacons(plaza.SURVEYED, plaza.SURVEY_SCALE, plaza.SURVEYED_START)
    counts = plaza.convert(data_dir, tmp_path / "log", name, where)
    assert counts["START"] == 1
    assert counts["WHEELS"] == len(increments)
    assert counts["RANGE"] == len(ranges)
    with LogFile(tmp_path / "log") as recording:
        events = list(recording)
    last: WheelsSample = decode("wheels_t", [each for each in events if each.channel == "WHEELS"][-1].data)
    left, right = (each.travel for each in last.wheels)
    assert (left + right) / 2 == pytest.approx(increments[:, 1].sum(), abs=1e-6)
    assert (right - left) / plaza.TRACK_WIDTH == pytest.approx(increments[:, 2].sum(), abs=1e-6)
    imu = [decode("imu_t", each.data).angular_velocity[2] for each in events if each.channel == "IMU"]
    turned = np.sum(np.array(imu) * np.diff(increments[:, 0]))
    assert turned == pytest.approx(increments[1:, 2].sum(), abs=1e-3)


def test_given_plaza_2_then_the_surveyed_beacons_belong_to_its_first_ranges(data_dir: Path) -> None:
    if not plaza.files(data_dir, "plaza2")[0].is_file():
        pytest.skip("no plaza2 among the recordings")
    increments, ranges = plaza.read(data_dir, "plaza2")
    where = plaza.find_beacons(data_dir, "plaza2")
    early = ranges[:, 0] < increments[0, 0] + 20.0
    off = plaza.range_residuals(plaza.dead_reckon(increments, where.start), increments[:, 0], ranges[early], where)
    assert early.sum() > 50
    assert plaza.rms(off) < 1.5


def test_given_the_husky_turned_then_its_wheels_and_mounts_are_the_same_vehicles(
    data_dir: Path, tmp_path: Path
) -> None:
    before = load_model(load_config(HUSKY).geometry)
    after = load_model(load_config(husky.write_turned_vehicle(HUSKY, tmp_path)).geometry)
    for frame in ("Imu:Origin", "Antenna:PhaseCenter"):
        was, now = (model.get_transformation(frame, "Husky:Base").pose for model in (before, after))
        assert now.xyz == pytest.approx((-was.xyz[0], -was.xyz[1], was.xyz[2]))
        axis = (0.3, -0.2, 0.9) if frame.startswith("Imu") else (0.0, 0.0, 0.0)
        x, y, z = np.subtract(was.transform(axis), was.xyz)
        assert np.subtract(now.transform(axis), now.xyz) == pytest.approx([-x, -y, z])

    if not husky.file(data_dir).is_file():
        pytest.skip("no husky/test1.bag among the recordings")
    husky.convert(data_dir, tmp_path / "log")
    with LogFile(tmp_path / "log") as recording:
        events = list(itertools.islice(recording, 2000))
    turned = list(husky.reverse_wheels(events))
    assert [(each.utime, each.channel) for each in turned] == [(each.utime, each.channel) for each in events]
    for was, now in zip(events, turned, strict=True):
        if was.channel != "WHEELS":
            assert now == was
            continue
        for a, b in zip(decode("wheels_t", was.data).wheels, decode("wheels_t", now.data).wheels, strict=True):
            assert (b.name, b.travel, b.speed) == (a.name, -a.travel, -a.speed)
            assert b.direction == (a.direction if a.direction is Direction.STOPPED else -a.direction)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # the scorer leaves a file open
@pytest.mark.parametrize("shift", [0.0, 0.15])
def test_given_gaps_when_scored_then_the_known_error_of_an_estimate_comes_out(
    shift: float, data_dir: Path, tmp_path: Path
) -> None:
    scorer = load_scorer(data_dir)
    if scorer is None:
        pytest.skip(f"no scorer beside {data_dir}")
    t = np.arange(0.0, 395.0, 0.4)
    fixes = FixTable(np.round(t * 1e6).astype(np.int64), np.column_stack([t, np.zeros(len(t))]))
    protocol = protocols.Protocol(fixes, shift)
    assert len(protocol.gap_starts) == (4 if shift == 0.0 else 3)  # the last one would end after the recording
    meta = tmp_path / "meta.json"
    meta.write_text(json.dumps(protocol.to_dict()))
    begin = protocol.gap_starts[0] * protocol.duration
    gap = (protocol.times > begin) & (protocol.times <= begin + 30.0)
    assert (protocol.withheld & gap).sum() == gap.sum() == 75
    off_by = np.where(gap[protocol.withheld], 3.0, 1.0)
    estimated = np.column_stack([t[protocol.withheld], off_by, *np.zeros((2, len(off_by)))])
    outcome = protocols._score(protocol, estimated, np.ones(len(off_by), bool), {}, scorer, tmp_path)
    assert [each.end_error for each in outcome.gaps] == pytest.approx([3.0, *[1.0] * (len(protocol.gap_starts) - 1)])
    count = len(outcome.gaps)
    assert protocols.mean_gap_end([outcome]) == pytest.approx((3.0 + count - 1) / count)


def test_given_a_required_figure_when_it_is_missed_then_the_line_is_marked() -> None:
    recording = accuracy.RECORDINGS[0]
    required = recording.targets["half"].required
    times = protocols.Integrity(seconds=400.0, valid=400.0)
    good = protocols.ReplayScore(400, 0, 1.0, rmse=required - 0.01, p95=0.6, max=1.0, integrity=times)
    assert accuracy.ResultLine(recording, "half", (good,)).is_met
    for bad in (
        replace(good, rmse=required + 0.01),
        replace(good, missing=1),
        replace(good, max=1000.0),
        replace(good, integrity=replace(times, valid=380.0)),
        replace(good, integrity=replace(times, misleading=1.0)),
        replace(good, integrity=replace(times, beyond_level=1.0)),
        protocols.ReplayScore(0, 400, 0.0),
    ):
        line = accuracy.ResultLine(recording, "half", (bad,))
        assert not line.is_met
        assert "OUT OF BOUNDS" in line.format()
