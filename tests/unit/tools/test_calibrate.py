"""`modelserver calibrate`."""

from __future__ import annotations

import html
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from support_recordings import HUSKY, LATENCY, START, write_log
from support_report import read_answer, read_figures, read_numbers
from support_tuning import write_vehicle

from modelserver.messages import FixType, GpsSample, ImuSample, SensorHeader
from modelserver.wire.codec import encode
from mstools import cli
from mstools.calibration.ellipsoid import fit_level
from mstools.report import charts

Run = Callable[..., tuple[int, str, str]]
Event = tuple[int, str, bytes]

RATE = 20
GYRO_NOISE, FORCE_NOISE = 1e-3, 3e-3
HARD = (5e-6, -8e-6, 3e-6)
PLACE = "42.36,-71.06"
NAN = (math.nan, math.nan, math.nan)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command; return its exit code, standard output and error."""

    def calibrate(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            cli.main(["calibrate", *(str(each) for each in arguments)])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return calibrate


def at(seconds: float, source: str = "imu") -> SensorHeader:
    utime = START + round(seconds * 1e6)
    return SensorHeader(utime, source, host_utime=utime + LATENCY)


def event(sample: ImuSample | GpsSample, channel: str) -> Event:
    return (sample.header.utime + LATENCY, channel, encode(sample))


def stationary_samples(seconds: float, begin: float = 0.0, moving: bool = False) -> Iterator[ImuSample]:
    """Yield the samples of a unit mounted as the Husky's: y up."""
    chance = np.random.default_rng(round(begin) + 1)
    count = round(seconds * RATE)
    rates = chance.normal(0.004, GYRO_NOISE * math.sqrt(RATE), (count, 3))
    forces = chance.normal((0.0, 9.8, 0.0), 1.0 if moving else FORCE_NOISE * math.sqrt(RATE), (count, 3))
    for n, (rate, force) in enumerate(zip(rates.tolist(), forces.tolist(), strict=True)):
        yield ImuSample(at(begin + n / RATE), angular_velocity=tuple(rate), specific_force=tuple(force))


def rotated_samples(turns: float = 2.0, seconds: float = 40.0) -> Iterator[ImuSample]:
    """Yield the samples of a unit on a vehicle that turns on the level, in Boston's field of that day."""
    chance = np.random.default_rng(4)
    for n, yaw in enumerate(np.linspace(0.0, 2.0 * np.pi * turns, round(seconds * RATE)).tolist()):
        field = np.array((20.5e-6 * math.cos(yaw), -20.5e-6 * math.sin(yaw), -47.5e-6)) + HARD
        field += chance.normal(0.0, 1e-7, 3)
        yield ImuSample(
            at(n / RATE),
            angular_velocity=(0.0, 0.0, 2.0 * math.pi * turns / seconds),
            specific_force=(0.0, 0.0, 9.8),
            magnetic_field=(float(field[0]), float(field[1]), float(field[2])),
        )


def log_of(path: Path, samples: Iterator[ImuSample] | list[ImuSample], channel: str = "IMU") -> Path:
    return write_log(path, [event(each, channel) for each in samples])


@pytest.fixture(scope="session")
def stationary_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of moving, then 100 of standing."""
    samples = [*stationary_samples(20.0, moving=True), *stationary_samples(100.0, begin=20.0)]
    return log_of(tmp_path_factory.mktemp("calibrate") / "stationary.lcm", samples)


@pytest.fixture(scope="session")
def turning_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return log_of(tmp_path_factory.mktemp("calibrate") / "turned.lcm", rotated_samples())


# --- the unit's noise ---------------------------------------------------------------------------------------


def test_given_a_stationary_unit_after_a_drive_when_calibrated_then_its_noise_while_stationary(
    stationary_log: Path, run: Run
) -> None:
    code, out, err = run("imu", stationary_log, "-o", "-")
    assert code == 0
    proposal = yaml.safe_load(out)["localization"]["filter"]
    assert proposal["gyro_noise"] == pytest.approx(GYRO_NOISE, rel=0.1)
    assert proposal["accelerometer_noise"] == pytest.approx(FORCE_NOISE, rel=0.1)
    assert "gyro_bias_walk" not in proposal
    (used,) = re.findall(r"used: ([\d.]+) to [\d.]+ s of the log \(([\d.]+) s\)", err)
    assert float(used[0]) == pytest.approx(20.0, abs=1.1)
    assert float(used[1]) == pytest.approx(100.0, abs=1.2)
    assert "gyro bias random walk: not determined" in err
    assert "mount" not in err


def test_given_a_stationary_unit_when_calibrated_then_the_text_reports_what_was_used_and_what_is_open(
    stationary_log: Path, run: Run
) -> None:
    code, out, err = run("imu", stationary_log)
    assert (code, err) == (0, "")
    assert "2400 samples, 20.0 Hz; stationary, used: 2" in out
    assert "angle random walk: 0.00" in out
    assert "gyro bias random walk: not determined" in out
    assert "record 10 minutes or more while stationary" in out


def test_given_the_huskys_file_when_calibrated_then_its_mount_agrees_and_an_upright_one_does_not(
    stationary_log: Path, tmp_path: Path, run: Run
) -> None:
    code, out, _ = run("imu", stationary_log, "-c", HUSKY)
    assert code == 0
    assert "mount: gravity is measured along the sensor's +y axis, 0." in out
    for name in ("vehicle.yaml", "geometry.yaml"):
        text = HUSKY.with_name(name).read_text()
        (tmp_path / name).write_text(text.replace("rpy_deg: [90, 0, -90]", "rpy_deg: [0, 0, 0]"))
    code, out, _ = run("imu", stationary_log, "-c", tmp_path / "vehicle.yaml")
    assert code == 0
    assert "but up in the geometry is +z: 90 deg apart; mounts that fit: rpy_deg [90, 0, 0]" in out


def test_given_a_plot_and_a_proposal_when_calibrated_then_both_files_are_whole(
    stationary_log: Path, tmp_path: Path, run: Run
) -> None:
    page, proposal = tmp_path / "allan.html", tmp_path / "imu.yaml"
    assert run("imu", stationary_log, "--plot", page, "-o", proposal)[0] == 0
    settings = yaml.safe_load(proposal.read_text())
    assert settings["localization"]["filter"]["gyro_noise"] == pytest.approx(GYRO_NOISE, rel=0.1)
    assert set(settings["localization"]["filter"]) == {"gyro_noise", "accelerometer_noise"}
    assert "# gyro_bias_walk: not determined" in proposal.read_text()
    gyro, accelerometer = read_figures(page)
    for figure in (gyro, accelerometer):
        assert {"x", "y", "z", "settings now", "settings proposed", "now"} <= {each["name"] for each in figure["data"]}
        assert figure["layout"]["xaxis"]["title"]["text"] == "averaging time τ, s"
        assert figure["layout"]["xaxis"]["type"] == figure["layout"]["yaxis"]["type"] == "log"
    headline, noise, walk, force, _ = read_answer(page)
    assert headline == "2 of 4 noise settings determined, no change is needed"
    assert re.fullmatch(r"gyro_noise: 0\.001 -> 0\.000\d+ \+- [\d.e-]+ rad/s/sqrt\(Hz\): no significant change", noise)
    assert re.fullmatch(r"gyro_bias_walk: not determined: no rise .*; record 10 minutes or more .*", walk)
    assert "no change, as the measured value is of the stationary unit" in force


def test_given_a_vehicle_file_with_other_values_when_calibrated_then_the_page_begins_with_the_change_and_its_remedy(
    stationary_log: Path, tmp_path: Path, run: Run
) -> None:
    vehicle = write_vehicle(HUSKY, tmp_path, {"filter": {"gyro_noise": 0.004}})
    page = tmp_path / "allan.html"
    assert run("imu", stationary_log, "-c", vehicle, "--plot", page)[0] == 0
    headline, change, *lines = read_answer(page)
    assert headline == "2 of 4 noise settings determined, 1 to change"
    assert re.fullmatch(
        r"gyro_noise: 0\.004 -> 0\.000\d+ \+- [\d.e-]+ rad/s/sqrt\(Hz\): set: the change is significant", change
    )
    assert any(each.startswith("Remedy: merge the lines below") for each in lines)
    assert "the mount is consistent" in lines[-1]
    # what to merge is the change alone
    text = page.read_text()
    merged = yaml.safe_load(html.unescape(text.partition("<pre>")[2].partition("</pre>")[0]))
    assert list(merged["localization"]["filter"]) == ["gyro_noise"]
    # the ratio of measured to configured deviation is 1/4 now, and 1 as proposed
    ratios = {each["name"]: read_numbers(each["y"]) for each in read_figures(page)[0]["data"]}
    assert ratios["now"][:5] == pytest.approx(0.25, rel=0.05)
    assert ratios["proposed"][:5] == pytest.approx(1.0, rel=0.05)


def test_given_a_file_that_exists_when_calibrated_then_it_is_not_overwritten_unless_forced(
    stationary_log: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "imu.yaml"
    out.write_text("precious")
    for option in ("-o", "--plot"):
        code, _, err = run("imu", stationary_log, option, out)
        assert (code, err.count("\n")) == (1, 1)
        assert "--force" in err
        assert out.read_text() == "precious"
    assert run("imu", stationary_log, "-o", out, "--force")[0] == 0
    assert "gyro_noise" in out.read_text()


def test_given_standard_output_for_the_proposal_then_only_it_goes_there(stationary_log: Path, run: Run) -> None:
    code, out, err = run("imu", stationary_log, "-o", "-")
    assert code == 0
    assert "localization" in yaml.safe_load(out)
    assert "angle random walk" in err


def test_given_half_a_minute_when_calibrated_then_it_reports_what_it_can_and_proposes_nothing(
    stationary_log: Path, tmp_path: Path, run: Run
) -> None:
    proposal = tmp_path / "imu.yaml"
    code, out, err = run("imu", stationary_log, "--from", 40, "--to", 70, "-o", proposal)
    assert (code, err.count("\n")) == (1, 1)
    assert "longest stationary range is 29.9 s; 60 s are needed" in err
    assert "angle random walk: 0.00" in out
    assert not proposal.exists()


def test_given_a_moving_vehicle_when_calibrated_then_that_is_reported(tmp_path: Path, run: Run) -> None:
    log = log_of(tmp_path / "moving.lcm", stationary_samples(70.0, moving=True))
    code, _, err = run("imu", log)
    assert (code, err.count("\n")) == (1, 1)
    assert "never stationary in 69.9 s" in err or "never stationary in 70.0 s" in err
    assert "10 minutes" in err


def test_given_a_moving_vehicle_when_calibrated_then_its_axis_of_up_is_reported_with_what_the_file_reports(
    tmp_path: Path, run: Run
) -> None:
    log = log_of(tmp_path / "moving.lcm", stationary_samples(70.0, moving=True))
    code, out, _ = run("imu", log, "-c", HUSKY)
    assert code == 1
    assert "from the IMU's +y axis, which points up" in out
    assert "mount: gravity is measured along the sensor's +y axis" in out
    assert "the mount is consistent" in out
    code, out, _ = run("imu", log)
    assert "mount" not in out


def test_given_samples_that_are_not_numbers_when_calibrated_then_they_are_left_out_and_counted(
    tmp_path: Path, run: Run
) -> None:
    samples = list(stationary_samples(90.0))
    for n in range(0, len(samples), 50):
        samples[n] = replace(samples[n], angular_velocity=NAN)
    samples[5] = replace(samples[5], specific_force=None)
    code, out, err = run("imu", log_of(tmp_path / "a.lcm", samples), "-o", "-")
    assert (code, "37 samples without rates or forces dropped" in err) == (0, True)
    assert yaml.safe_load(out)["localization"]["filter"]["gyro_noise"] == pytest.approx(GYRO_NOISE, rel=0.1)


def test_given_a_unit_that_reports_no_rates_when_calibrated_then_that_is_reported(tmp_path: Path, run: Run) -> None:
    log = log_of(tmp_path / "a.lcm", [ImuSample(at(n * 0.1), specific_force=(0.0, 0.0, 9.8)) for n in range(100)])
    code, _, err = run("imu", log)
    assert (code, err.count("\n")) == (1, 1)
    assert "100 samples on IMU, none with angular velocity and specific force" in err


def test_given_a_frozen_unit_when_calibrated_then_nothing_is_proposed(tmp_path: Path, run: Run) -> None:
    sample = next(iter(stationary_samples(1.0)))
    log = log_of(tmp_path / "a.lcm", [replace(sample, header=at(n * 0.1)) for n in range(700)])
    out, page = tmp_path / "imu.yaml", tmp_path / "allan.html"
    code, words, err = run("imu", log, "-o", out, "--plot", page)
    assert (code, err.count("\n")) == (1, 1)
    assert "frozen" in err
    assert "all values are equal" in words
    assert not out.exists()
    assert len(read_figures(page)) == 2
    headline, why, *_ = read_answer(page)
    assert headline == "Nothing is proposed"
    assert why.startswith("No figure follows from 70 s: the samples are frozen")


# --- the magnetometer ---------------------------------------------------------------------------------------


def test_given_two_turns_when_calibrated_then_the_iron_is_found(turning_log: Path, run: Run) -> None:
    code, out, err = run("magnetometer", turning_log, "--place", PLACE, "-o", "-")
    assert code == 0
    proposal = yaml.safe_load(out)["localization"]["magnetometer"]
    assert proposal["hard_iron"][:2] == pytest.approx(HARD[:2], abs=3e-8)
    soft = np.array(proposal["soft_iron"]).reshape(3, 3)
    assert soft == pytest.approx(np.eye(3), abs=0.02)
    assert "12 of 12 sectors" in err
    # World Magnetic Model for Boston, end of 2023: 20.5 microtesla horizontal, 51.6 in total
    (field,) = re.findall(r"field at 42\.3600, -71\.0600: ([\d.]+) uT", err)
    assert float(field) == pytest.approx(51.6, rel=0.01)


def test_given_fixes_in_the_log_when_calibrated_then_they_give_the_position(tmp_path: Path, run: Run) -> None:
    fix = GpsSample(at(3.0, "gps"), FixType.FIX_3D, 42.36, -71.06, height_ellipsoidal=10.0)
    none = replace(fix, fix_type=FixType.NONE, latitude_deg=0.0)
    events = [*(event(each, "IMU") for each in rotated_samples()), event(fix, "GPS"), event(none, "GPS")]
    code, out, _ = run("magnetometer", write_log(tmp_path / "a.lcm", events))
    assert code == 0
    assert "field at 42.3600, -71.0600: 51." in out
    assert "12 of 12 sectors of 30 degrees seen" in out


def test_given_no_place_when_calibrated_then_the_strength_is_left_open(turning_log: Path, run: Run) -> None:
    code, out, _ = run("magnetometer", turning_log)
    assert code == 0
    assert "position unknown: the horizontal field is set to the measured mean, 20.5" in out
    assert "Vertical hard iron is not determined" in out


def test_given_a_plot_and_a_proposal_when_calibrated_then_before_and_after(
    turning_log: Path, tmp_path: Path, run: Run
) -> None:
    page, proposal = tmp_path / "circle.html", tmp_path / "magnetometer.yaml"
    assert run("magnetometer", turning_log, "--plot", page, "-o", proposal)[0] == 0
    settings = yaml.safe_load(proposal.read_text())["localization"]["magnetometer"]
    assert settings["hard_iron"][:2] == pytest.approx(HARD[:2], abs=3e-8)
    assert len(settings["soft_iron"]) == 9
    residuals, field = read_figures(page)
    assert [each["name"] for each in field["data"]] == ["measured", "calibrated", "mean radius"]
    errors, before, after = (read_numbers(each["y"]) for each in residuals["data"] if each["mode"] == "markers")
    # the vehicle's own field across the earth's turns heading by asin(9.4 / 20.5)
    assert max(abs(errors)) == pytest.approx(math.degrees(math.asin(math.hypot(*HARD[:2]) / 20.5e-6)), rel=0.02)
    assert max(abs(before)) == pytest.approx(1e6 * math.hypot(*HARD[:2]), rel=0.1)
    assert max(abs(after)) < 0.5
    headline, hard, *_, last = read_answer(page)
    assert headline.startswith("Heading is wrong by up to 27.")
    assert hard.startswith("hard_iron, µT: [0.000, 0.000, 0.000] -> [5.0")
    assert "--place" in last


def test_given_the_vehicle_file_has_the_correction_when_calibrated_then_no_change_is_significant(
    turning_log: Path, tmp_path: Path, run: Run
) -> None:
    proposal, page = tmp_path / "magnetometer.yaml", tmp_path / "circle.html"
    assert run("magnetometer", turning_log, "--place", PLACE, "-o", proposal)[0] == 0
    vehicle = write_vehicle(HUSKY, tmp_path, yaml.safe_load(proposal.read_text())["localization"])
    assert run("magnetometer", turning_log, "--place", PLACE, "-c", vehicle, "--plot", page)[0] == 0
    (headline,) = read_answer(page)
    assert re.fullmatch(r"No significant change; the error of heading is 0\.\d+ degrees rms", headline)


def test_given_many_turns_when_fitted_then_the_results_scatter_by_their_sigma() -> None:
    chance = np.random.default_rng(3)
    yaw = np.linspace(0.0, 4.0 * np.pi, 400, endpoint=False)
    circle = np.column_stack([20e-6 * np.cos(yaw), 20e-6 * np.sin(yaw), np.full(400, -45e-6)])
    fits = [
        fit_level(circle + chance.normal(0.0, 2e-7, circle.shape), (0.0, 0.0, 9.8), 20e-6, -45e-6) for _ in range(100)
    ]
    # Tukey's weights cost 5 %, and the sigma of 100 values is known to 7 %
    hard, soft = (np.std([getattr(each, name)[0] for each in fits]) for name in ("hard_iron", "soft_iron"))
    assert hard == pytest.approx(fits[0].hard_iron_sigma, rel=0.25)
    assert soft == pytest.approx(fits[0].soft_iron_sigma, rel=0.25)


def test_given_a_quarter_turn_when_calibrated_then_it_reports_what_was_seen(tmp_path: Path, run: Run) -> None:
    log = log_of(tmp_path / "quarter.lcm", rotated_samples(turns=0.3))
    code, out, err = run("magnetometer", log)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "full circle" in err


def test_given_a_unit_without_a_magnetometer_when_calibrated_then_that_is_reported(
    stationary_log: Path, run: Run
) -> None:
    code, out, err = run("magnetometer", stationary_log)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "2400 samples on IMU, none with a magnetic field: it has no magnetometer" in err


def test_given_stamps_of_no_model_when_calibrated_then_it_is_reported_and_the_strength_left_open(
    tmp_path: Path, run: Run
) -> None:
    samples = [
        replace(each, header=replace(each.header, utime=each.header.utime - START + 1)) for each in rotated_samples()
    ]
    code, out, err = run("magnetometer", log_of(tmp_path / "a.lcm", samples), "--place", PLACE)
    assert code == 0
    assert "outside the World Magnetic Model's years" in err
    assert "position unknown" not in out
    assert "is set to the measured mean" in out


# --- bad input ----------------------------------------------------------------------------------------------

BOTH = pytest.mark.parametrize("subcommand", ["imu", "magnetometer"])


@BOTH
@pytest.mark.parametrize("content", [b"", os.urandom(50_000), b"<Model/>"])
def test_given_no_log_then_one_clear_error(tmp_path: Path, run: Run, subcommand: str, content: bytes) -> None:
    log = tmp_path / "junk.lcm"
    log.write_bytes(content)
    code, out, err = run(subcommand, log)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "junk.lcm" in err
    code, _, err = run(subcommand, tmp_path / "nowhere.lcm")
    assert (code, err.count("\n")) == (1, 1)


@BOTH
def test_given_another_channel_then_the_nearest_is_offered(stationary_log: Path, run: Run, subcommand: str) -> None:
    code, _, err = run(subcommand, stationary_log, "--channel", "IMUU")
    assert (code, err.count("\n")) == (1, 1)
    assert "no messages on channel IMUU; nearest: IMU" in err


@BOTH
def test_given_a_channel_of_another_type_then_that_is_reported(tmp_path: Path, run: Run, subcommand: str) -> None:
    fix = GpsSample(at(1.0, "gps"), FixType.FIX_3D, 42.0, -71.0)
    log = write_log(tmp_path / "gps.lcm", [event(fix, "GPS")])
    code, _, err = run(subcommand, log, "--channel", "GPS")
    assert (code, err.count("\n")) == (1, 1)
    assert "has no imu_t" in err


@BOTH
def test_given_times_past_the_end_then_that_is_reported(stationary_log: Path, run: Run, subcommand: str) -> None:
    code, _, err = run(subcommand, stationary_log, "--from", 1000)
    assert code == 1
    assert "none of 2400 messages on IMU lies between" in err


def test_given_junk_on_the_channel_and_a_torn_end_then_both_are_reported(
    stationary_log: Path, tmp_path: Path, run: Run
) -> None:
    log = tmp_path / "torn.lcm"
    junk = write_log(tmp_path / "junk.lcm", [(START, "IMU", b"junk")])
    log.write_bytes(junk.read_bytes() + stationary_log.read_bytes()[:-5])
    code, _, err = run("imu", log)
    assert code == 0
    assert "1 message of the channel left out" in err
    assert "is truncated" in err


@pytest.mark.parametrize(
    "options",
    [
        ["--from", "5", "--to", "5"],
        ["--from", "-1"],
        ["--from", "nan"],
        ["--to", "nan"],
        ["--plot", "a", "-o", "a"],
        ["--nonsense"],
    ],
)
def test_given_wrong_options_then_usage(
    stationary_log: Path, run: Run, options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("imu", stationary_log, *options)[0] == 2
    assert run("magnetometer", stationary_log, *options)[0] == 2


@pytest.mark.parametrize("place", ["42", "north,west", "91,0", "nan,0", "1,2,3"])
def test_given_no_place_then_usage(turning_log: Path, run: Run, place: str) -> None:
    code, _, err = run("magnetometer", turning_log, "--place", place)
    assert code == 2
    assert "latitude,longitude" in err


def test_given_the_log_as_output_then_it_is_not_touched(stationary_log: Path, run: Run) -> None:
    before = stationary_log.read_bytes()
    assert run("imu", stationary_log, "-o", stationary_log, "--force")[0] == 2
    assert stationary_log.read_bytes() == before


@pytest.mark.parametrize("subcommand", ["", "imu", "magnetometer"])
def test_given_help_then_there_is_an_example(run: Run, subcommand: str) -> None:
    code, out, _ = run(*([subcommand] if subcommand else []), "--help")
    assert code == 0
    assert f"modelserver calibrate {subcommand or 'imu'}" in out


def test_given_another_command_then_nothing_of_this_is_imported() -> None:
    script = (
        "import sys, mstools.cli as cli\n"
        "try: cli.main(['query', '--help'])\n"
        "except SystemExit: print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not any("calibrat" in each or "pygeomag" in each for each in done.stderr.split())


# --- drawing ------------------------------------------------------------------------------------------------


def test_given_values_then_a_logarithmic_axis_has_whole_decades() -> None:
    for values, ends in (([0.03, 5.0], (0.01, 10.0)), ([1.0], (1.0, 10.0)), ([], (0.1, 10.0))):
        axis = charts.decade_axis("t", values)
        assert (axis.low, axis.high) == pytest.approx(ends)
    assert charts.Axis("x", -30.0, 30.0).fraction(0.0) == 0.5
    assert math.isnan(charts.decade_axis("t", [1.0]).fraction(-1.0))
