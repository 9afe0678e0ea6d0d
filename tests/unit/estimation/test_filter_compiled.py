"""The compiled filter has the results of the plain one, bit for bit.

$MODELSERVER_COMPILED names a folder with the unpacked wheel of `MODELSERVER_COMPILE=1`. CI sets it, and runs the other
tests of this folder with that build too; without it these tests are skipped.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from modelserver.version import __version__

ROOT = Path(__file__).resolve().parents[3]
COMPILED = os.environ.get("MODELSERVER_COMPILED", "")

pytestmark = pytest.mark.skipif(not COMPILED, reason="MODELSERVER_COMPILED names no compiled build")

SIMULATED = """
from support_cart import drive, localizer

state = localizer()
for number, sample in enumerate(drive(40.0)[1]):
    state, events = state.process(sample)
    for event in events:
        print(event)
    if not number % 7:
        estimate = state.estimate(sample.header.utime + 30_000)
        print(estimate, estimate.motion and estimate.motion.covariance())
print(state.navigation(state.utime))
"""

RECORDED = """
import sys
from pathlib import Path
from modelserver.config.vehicle_file import load_config
from modelserver.server.offline import OfflineRun
from modelserver.server.vehicle import load_vehicle
from modelserver.wire.eventlog import LogFile
from mstools.commands.import_bag import import_bag

import_bag(Path(sys.argv[1]), Path("husky.lcm"))
vehicle = load_vehicle(load_config(Path(sys.argv[2])))
with LogFile(Path("husky.lcm")) as log:
    for row in OfflineRun(vehicle, log, vehicle.config.base_frame, on_decision=print).rows(None, 20.0):
        print(row)
"""


def run_with(build: Path, folder: Path, script: str, *arguments: Path) -> str:
    """Return what a script prints with the packages of a folder; each in a folder of its own."""
    paths = [build, build / "lcmtypes", build / "tools", build / "drivers", ROOT / "tests"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths)), "OPENBLAS_NUM_THREADS": "1"}
    folder.mkdir()
    version = [sys.executable, "-P", "-c", "from mstools.cli import main; main()", "--version"]
    shown = subprocess.run(version, env=environment, cwd=folder, capture_output=True, text=True, check=True).stdout
    assert shown == f"modelserver {__version__}{' (compiled filter)' if build != ROOT else ''}\n"
    command = [sys.executable, "-P", "-c", script, *map(str, arguments)]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def compare_builds(folder: Path, script: str, *arguments: Path) -> None:
    plain = run_with(ROOT, folder / "plain", script, *arguments).splitlines()
    compiled = run_with(Path(COMPILED), folder / "compiled", script, *arguments).splitlines()
    assert len(plain) > 500
    assert [pair for pair in zip(plain, compiled, strict=True) if pair[0] != pair[1]] == []


@pytest.mark.slow
def test_given_a_simulated_drive_then_all_estimates_and_decisions_are_the_same_bits(tmp_path: Path) -> None:
    compare_builds(tmp_path, SIMULATED)


@pytest.mark.slow
@pytest.mark.realdata
def test_given_a_recording_then_all_estimates_and_decisions_are_the_same_bits(tmp_path: Path, data_dir: Path) -> None:
    compare_builds(tmp_path, RECORDED, data_dir / "husky" / "test1.bag", ROOT / "config" / "husky" / "vehicle.yaml")
