"""Tuning: the search by itself, and the command on a drive whose noise differs from the settings."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from support_lcm import TIMEOUT_S
from support_recordings import HUSKY, drive, write_log
from support_tuning import RAPTOR, write_simulated_log

from modelserver.config.vehicle_file import load_config
from modelserver.messages import FixType, GpsSample, SensorHeader
from modelserver.server.vehicle import load_vehicle
from modelserver.simulation import GpsModel, Timing, WheelsModel
from mstools import cli
from mstools.commands.tune import (
    TUNABLES,
    EvaluationJob,
    Parameter,
    Score,
    choose_parameters,
    evaluate,
    mixture_log_density,
    search,
)

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def tune(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            cli.main(["tune", *(str(each) for each in arguments)])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return tune


# --- the search ---------------------------------------------------------------------------------------------


class Hill:
    """A likelihood that is highest at `top`; `asked` counts its evaluations."""

    def __init__(self, begin: Mapping[str, float], top: Mapping[str, float], rmse: Mapping[str, float] | None = None):
        self.begin, self.top, self.rmse = begin, top, rmse or {}
        self.asked = 0

    def __call__(self, trials: Sequence[Mapping[str, float]]) -> list[Score | None]:
        self.asked += len(trials)
        return [self.score({**self.begin, **each}) for each in trials]

    def score(self, values: Mapping[str, float]) -> Score:
        height = -sum(math.log2(values[name] / top) ** 2 for name, top in self.top.items())
        return Score(height, 1.0 + sum(slope * math.log2(values[n] / self.begin[n]) for n, slope in self.rmse.items()))


def test_given_a_hill_when_searched_then_each_setting_goes_to_its_top() -> None:
    begin = {"a": 1.0, "b": 1.0, "c": 1.0}
    hill = Hill(begin, {"a": 4.0, "b": 0.5})
    found = search(begin, hill.score(begin), [Parameter(name) for name in begin], hill)
    assert found.settings == {"a": 4.0, "b": 0.5}
    assert found.insensitive == ("c",)
    assert found.score.likelihood == 0.0
    assert [(each.name, each.after) for each in found.steps] == [("a", 2.0), ("a", 4.0), ("b", 0.5)]
    assert hill.asked < 20


def test_given_a_gain_that_costs_accuracy_then_the_step_is_not_taken() -> None:
    begin = {"a": 1.0}
    hill = Hill(begin, {"a": 4.0}, rmse={"a": 0.5})
    assert search(begin, hill.score(begin), [Parameter("a")], hill).settings == {}


@pytest.mark.parametrize(
    ("first", "after", "expected"), [(1.0, 1.9, 4.0), (1.0, 3.0, 1.0), (3.0, 2.9, 4.0), (3.0, 3.1, 1.0)]
)
def test_given_a_gain_that_makes_the_filter_overconfident_in_gaps_then_the_step_is_not_taken(
    first: float, after: float, expected: float
) -> None:
    begin = {"a": 1.0}
    hill = Hill(begin, {"a": 4.0})

    def evaluate(trials: Sequence[Mapping[str, float]]) -> list[Score | None]:
        return [replace(score, nees=after) for score in hill(trials) if score is not None]

    found = search(begin, replace(hill.score(begin), nees=first), [Parameter("a")], evaluate)
    assert found.settings.get("a", 1.0) == expected


def test_given_bounds_then_the_search_stays_within_and_not_far_from_where_it_began() -> None:
    begin = {"a": 1.0, "b": 1.0}
    hill = Hill(begin, {"a": 1000.0, "b": 1000.0})
    found = search(begin, hill.score(begin), [Parameter("a", high=3.0), Parameter("b")], hill)
    assert found.settings == {"a": 3.0, "b": 8.0}


def test_given_settings_that_cannot_be_then_others_are_tried() -> None:
    begin = {"a": 1.0}
    hill = Hill(begin, {"a": 0.25})

    def evaluate(trials: Sequence[Mapping[str, float]]) -> list[Score | None]:
        return [None if each.get("a", 1.0) > 1.0 else hill([each])[0] for each in trials]

    assert search(begin, hill.score(begin), [Parameter("a")], evaluate).settings == {"a": 0.25}


def test_given_residuals_then_the_true_covariance_is_the_most_likely() -> None:
    draws = np.random.default_rng(3).normal(0.0, 0.5, (2000, 2))
    draws[::100] += 30.0

    def likelihood(sigma: float) -> float:
        return sum(mixture_log_density(each, np.eye(2) * sigma**2) for each in draws)

    assert max((0.125, 0.25, 0.5, 1.0, 2.0), key=likelihood) == 0.5


def test_given_the_settings_that_are_tuned_then_all_are_the_filters_and_within_bounds() -> None:
    settings = load_config(RAPTOR).localization.filter
    for each in TUNABLES:
        assert each.low <= getattr(settings, each.name) <= each.high


# --- the command --------------------------------------------------------------------------------------------


WHEELS = WheelsModel(Timing(10.0))


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A drive whose fixes have white errors of 0.6 m, as they state. Few wheel samples, for a short computing time."""
    receiver = GpsModel(Timing(3.0), correlated_sigma=0.0, white_sigma=0.6, has_velocity=False)
    return write_simulated_log(tmp_path_factory.mktemp("noisy"), seconds=30.0, gps_model=receiver, wheels_model=WHEELS)


@pytest.mark.slow
def test_given_fixes_that_scatter_more_than_is_set_when_tuned_then_more_is_taken_for_new(
    noisy: tuple[Path, Path], tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mstools.commands.tune.TUNABLES", TUNABLES[:1])
    log, config = noisy
    out = tmp_path / "proposal.yaml"
    before = config.read_bytes()
    code, words, err = run(log, "-c", config, "--quick", "-o", out)
    assert code == 0
    assert "RMSE at withheld fixes" in words
    assert "gps_white_share: 0.15 -> 0.3" in err
    proposed = yaml.safe_load(out.read_text())["localization"]["filter"]
    assert proposed["gps_white_share"] >= 0.3
    assert config.read_bytes() == before


@pytest.mark.slow
def test_given_the_same_drive_when_tuned_twice_then_the_same_is_reported(
    noisy: tuple[Path, Path], run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mstools.commands.tune.TUNABLES", TUNABLES[:0])
    first, second = (run(*noisy[:1], "-c", noisy[1], "--quick") for _ in range(2))
    assert first[0] == 0
    assert first[1] == second[1]
    (withheld,) = re.findall(r"(\d+) fixes withheld in turn, 4 gaps; 2 runs", first[1])
    assert int(withheld) > 20
    (errors,) = re.findall(r"RMSE at withheld fixes, m +([\d.]+) +([\d.]+)", first[1])
    assert errors[0] == errors[1]
    assert float(errors[0]) < 2.0
    assert "No step helps enough" in first[1]


@pytest.mark.slow
def test_given_settings_that_are_overconfident_in_gaps_then_they_lose_by_the_ends_of_the_gaps(tmp_path: Path) -> None:
    receiver = GpsModel(Timing(3.0), correlated_sigma=1.0, time_constant=20.0, white_sigma=0.1, has_velocity=False)
    log, config = write_simulated_log(tmp_path, seconds=60.0, gps_model=receiver, wheels_model=WHEELS)
    overconfident = (("gps_correlation_time", 900.0),)
    good, bad = (evaluate(EvaluationJob(log, config, "outage", each)) for each in ((), overconfident))
    assert len(good.nees) == len(bad.nees) == len(good.gaps) == 4
    assert np.mean(bad.nees) > 1.3 * np.mean(good.nees)
    # the errors are much the same: the covariance is what makes the difference
    assert np.mean(bad.gaps) < 1.1 * np.mean(good.gaps)
    assert bad.likelihood < good.likelihood - 1.0
    half, half_bad = (evaluate(EvaluationJob(log, config, "half", each)) for each in ((), overconfident))
    assert half_bad.likelihood > half.likelihood - 0.1
    assert half.nees == half.gaps == ()


def test_given_the_types_of_fixes_then_their_range_error_is_tuned() -> None:
    vehicle = load_vehicle(load_config(RAPTOR))

    def choose(*types: FixType, quick: bool = False) -> set[str]:
        fixes = [GpsSample(SensorHeader(1, "gps"), each, 50.0, -111.0) for each in types]
        return {each.name for each in choose_parameters(vehicle, fixes, quick=quick) if "uere" in each.name}

    assert choose(FixType.FIX_3D, quick=True) == choose(FixType.NONE) == choose(FixType.FIX_2D) == {"uere"}
    assert choose(FixType.RTK_FIXED, FixType.RTK_FLOAT) == {"uere_rtk_fixed", "uere_rtk_float"}
    assert choose(FixType.DIFFERENTIAL) == {"uere_differential"}


def test_given_no_vehicle_then_usage(tmp_path: Path, run: Run) -> None:
    code, _, err = run(write_log(tmp_path / "drive.lcm", drive(1.0)))
    assert code == 2
    assert "tune needs the vehicle" in err


def test_given_a_log_without_fixes_then_that_is_reported(tmp_path: Path, run: Run) -> None:
    log = write_log(tmp_path / "drive.lcm", [each for each in drive(5.0) if each[1] == "IMU"])
    code, out, err = run(log, "-c", HUSKY)
    assert (code, out) == (1, "")
    assert "0 of 0 messages on GPS are good fixes" in err


def test_given_a_vehicle_without_gps_then_that_is_reported(tmp_path: Path, run: Run) -> None:
    config = tmp_path / "vehicle.yaml"
    config.write_text(f"vehicle: V\ngeometry: {HUSKY.with_name('geometry.yaml')}\nbase_frame: Husky:Base\n")
    code, _, err = run(write_log(tmp_path / "drive.lcm", drive(1.0)), "-c", config)
    assert code == 1
    assert "no GPS is configured (sensors.gps)" in err


def test_given_a_log_that_is_not_there_then_one_line(tmp_path: Path, run: Run) -> None:
    code, _, err = run(tmp_path / "no.lcm", "-c", HUSKY)
    assert (code, err.count("\n")) == (1, 1)
    assert "no.lcm" in err


def test_given_a_stationary_vehicle_then_it_reports_that_nothing_can_be_scored(tmp_path: Path, run: Run) -> None:
    log = write_log(tmp_path / "drive.lcm", [each for each in drive(8.0) if each[1] == "GPS"])
    code, _, err = run(log, "-c", HUSKY, "--quick")
    assert code == 1
    assert "no pose at any withheld fix" in err
    assert "--report" in err


def test_given_a_proposal_that_exists_then_it_stays(tmp_path: Path, run: Run) -> None:
    log = write_log(tmp_path / "drive.lcm", drive(1.0))
    out = tmp_path / "proposal.yaml"
    out.write_text("precious")
    code, _, err = run(log, "-c", HUSKY, "-o", out)
    assert code == 1
    assert "--force" in err
    assert out.read_text() == "precious"
    assert run(log, "-c", HUSKY, "-o", log)[0] == 2


INTERRUPTED = """
import sys
import time
from pathlib import Path
from mstools import cli
from mstools.commands import tune

def read_pipe(job: tune.EvaluationJob) -> None:
    job.config.read_bytes()

def command(log: Path, config: Path) -> None:
    with tune.open_pool("") as runs:
        runs([tune.EvaluationJob(log, config, "half", ())] * 2)

# in the workers too: each imports this file
tune.evaluate = read_pipe
tune.command = command
if __name__ == "__main__":
    cli.main(["tune", *sys.argv[1:]])
"""


def open_for_writing(pipe: Path, process: subprocess.Popen[str]) -> int:
    """Open a pipe once a process reads it, and fail where that ends before."""
    end = time.monotonic() + TIMEOUT_S
    while True:
        with suppress(OSError):  # nobody reads yet
            return os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.slow
def test_given_ctrl_c_while_workers_run_then_all_end_at_once_with_130(tmp_path: Path) -> None:
    # a worker that reads a pipe which nobody writes never ends by itself
    config, script = tmp_path / "pipe", tmp_path / "interrupted.py"
    os.mkfifo(config)
    script.write_text(INTERRUPTED)
    with (
        subprocess.Popen(
            [sys.executable, script, tmp_path / "drive.lcm", config],
            start_new_session=True,
            stderr=subprocess.PIPE,
            text=True,
        ) as process,
        os.fdopen(open_for_writing(config, process), "wb", buffering=0) as pipe,
    ):
        os.killpg(process.pid, signal.SIGINT)
        try:
            _, err = process.communicate(timeout=TIMEOUT_S)
        finally:
            process.kill()
        with pytest.raises(BrokenPipeError):
            pipe.write(b"vehicle")  # no worker is left to read it
    assert process.returncode == 130
    assert "Traceback" not in err
