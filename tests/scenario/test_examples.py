"""Clients written from the .lcm files alone, in three languages, against the running daemon; and other examples."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support_lcm import running_daemon

import modelserver as ms

ROOT = Path(__file__).resolve().parents[2]
RAPTOR = ROOT / "config" / "raptor"
NEEDED = {"python": ("make",), "c": ("make", "cc"), "java": ("make", "javac", "java")}
LANGUAGES = sorted(NEEDED)


@pytest.fixture(scope="module")
def daemon_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running_daemon(RAPTOR / "vehicle.yaml", tmp_path_factory.mktemp("daemon")) as url:
        yield url


@pytest.fixture(scope="module", params=LANGUAGES)
def query(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    language: str = request.param
    missing = [tool for tool in NEEDED[language] if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"the {language} client needs {', '.join(missing)}")
    folder = tmp_path_factory.getbasetemp()
    # parallel workers share one build: the parent folder of theirs is that of the whole run
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    with (folder / f"{language}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return build_client(language, folder / f"client_{language}")


def build_client(language: str, folder: Path) -> Path:
    """Build a client outside the source tree, as in its README; make skips what is already built."""
    arguments = [f"BUILD={folder}", f"PYTHON={sys.executable}", "CFLAGS=-O0"]
    done = subprocess.run(
        ["make", "-C", ROOT / "examples" / f"client_{language}", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "query"


def _run(query: Path, url: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"LCM_DEFAULT_URL": url}
    return subprocess.run([query, *arguments], env=environment, capture_output=True, text=True, timeout=60)


def _numbers(output: str, key: str) -> list[float]:
    (line,) = [line for line in output.splitlines() if line.startswith(key)]
    return [float(word) for word in line.split()[1:]]


@pytest.mark.parametrize(
    ("interest", "reference"),
    [
        ("Digiclops:ImagePlane", "FrontNoddingSICK:Origin"),
        ("FrontNoddingSICK:Origin", "Digiclops:ImagePlane"),
        ("GPSAntenna:PhaseCenter", "Raptor:CG"),
    ],
)
def test_given_two_frames_when_asked_then_the_answer_is_the_models(
    query: Path, daemon_url: str, interest: str, reference: str
) -> None:
    done = _run(query, daemon_url, interest, reference)
    assert done.returncode == 0, done.stderr
    expected = ms.load_model(RAPTOR / "geometry.yaml").get_transformation(interest, reference)
    assert done.stdout.startswith(f"{interest} in {reference}\n")
    np.testing.assert_allclose(_numbers(done.stdout, "position_m"), expected.position, atol=2e-6)
    np.testing.assert_allclose(_numbers(done.stdout, "rpy_deg"), np.degrees(expected.rpy), atol=2e-6)
    assert _numbers(done.stdout, "utime") == [0.0]
    assert "\nvalid yes\n" in done.stdout


def test_given_a_mistyped_frame_when_asked_then_the_nearest_name_is_reported(query: Path, daemon_url: str) -> None:
    done = _run(query, daemon_url, "Digiclops:ImagePlan", "Raptor:CG")
    assert done.returncode == 1
    assert done.stdout == ""
    assert "status 2" in done.stderr
    assert "Nearest: Digiclops:ImagePlane" in done.stderr


def test_given_no_pose_yet_when_the_world_is_asked_for_then_the_reason_is_reported(
    query: Path, daemon_url: str
) -> None:
    done = _run(query, daemon_url, "Raptor:CG", "World:UTM")
    assert done.returncode == 1
    assert "status 4" in done.stderr
    assert "GPS" in done.stderr


def test_given_no_server_when_asked_then_it_reports_it(query: Path, lcm_url: str) -> None:
    done = _run(query, lcm_url, "Digiclops:ImagePlane", "Raptor:CG")
    assert done.returncode == 1
    assert "is the server running?" in done.stderr


def test_given_one_argument_when_run_then_usage_is_reported(query: Path, lcm_url: str) -> None:
    done = _run(query, lcm_url, "Digiclops:ImagePlane")
    assert done.returncode == 2
    assert "usage: query FRAME_OF_INTEREST FRAME_OF_REFERENCE" in done.stderr


def test_given_the_example_for_asyncio_then_platform_and_mirror_report_the_same(daemon_url: str) -> None:
    path = ROOT / "examples" / "python" / "asyncio_client.py"
    pair = ("Digiclops:ImagePlane", "GPSAntenna:PhaseCenter")
    done = subprocess.run(
        [sys.executable, path, *pair],
        env=os.environ | {"LCM_DEFAULT_URL": daemon_url},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    first, second = (line.rsplit(" ", 3)[1:] for line in done.stdout.splitlines() if "in Odom:" not in line)
    expected = ms.load_model(RAPTOR / "geometry.yaml").get_transformation(*pair).position
    np.testing.assert_allclose([list(map(float, each)) for each in (first, second)], [expected] * 2, atol=2e-6)


def test_given_the_example_for_asyncio_and_a_mistyped_frame_then_the_nearest_is_reported(daemon_url: str) -> None:
    path = ROOT / "examples" / "python" / "asyncio_client.py"
    done = subprocess.run(
        [sys.executable, path, "Digiclops:ImagePlan", "Raptor:CG"],
        env=os.environ | {"LCM_DEFAULT_URL": daemon_url},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 1
    assert "ImagePlan" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("language", LANGUAGES)
def test_given_a_client_then_it_is_written_without_modelserver(language: str) -> None:
    for path in (ROOT / "examples" / f"client_{language}").iterdir():
        if path.is_file():
            assert "modelserver" not in path.read_text(encoding="utf-8")


def test_given_the_example_of_an_own_measurement_then_it_takes_few_lines_and_helps() -> None:
    path = ROOT / "examples" / "python" / "own_measurement.py"
    _, part = path.read_text(encoding="utf-8").split("# --- the measurement", 1)
    lines = part.split("# --- a simulated drive", 1)[0].splitlines()[1:]
    assert sum(bool(line.strip()) for line in lines) < 40
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    without, with_it = (float(line.rsplit(" ", 2)[1]) for line in done.stdout.splitlines())
    assert with_it < 0.5 * without
