"""`modelserver up` as a person runs it: one terminal, one Ctrl-C, and a valid pose without hardware."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import time
import urllib.error
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import pytest
from support_lcm import MODELSERVER, TIMEOUT_S, invoke

import modelserver as ms
from tests.scenario.test_demo import close, list_running, text_until

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "python" / "own_device.py"

GEOMETRY = """\
modelserver: geometry/1
name: Cart
bodies:
  Cart: {frames: {Base: {}, Antenna: {xyz: [0, 0, 1]}, Unit: {xyz: [0.1, 0, 0.3]}}}
"""

VEHICLE = """\
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Base
state_directory: state
sensors:
  gps: {channel: GPS, frame: "Cart:Antenna"}
  imu: {channel: IMU, frame: "Cart:Unit"}
drivers:
  gps: {device: novatel, port: /dev/ttyGPS, rate_hz: 10}
  imu: {device: gx1, port: /dev/ttyIMU}
"""


@pytest.fixture
def cart(tmp_path: Path) -> Path:
    (tmp_path / "geometry.yaml").write_text(GEOMETRY)
    path = tmp_path / "vehicle.yaml"
    path.write_text(VEHICLE)
    return path


def start_up(cart: Path, url: str, *options: str, **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*MODELSERVER, "up", "-c", str(cart), "--url", url, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"} | environment,
    )


@pytest.mark.skipif(find_spec("viser") is None, reason="the extra view is not installed")
def test_given_emulated_devices_then_pose_and_viewer_are_there_and_all_end_with_ctrl_c(
    cart: Path, lcm_url: str
) -> None:
    process = start_up(cart, lcm_url, "--emulate", "--view", BROWSER="true")
    emulated = str(cart.parent / "emulated" / "vehicle.yaml")
    try:
        shown = text_until(process, r" *view \| live: http")
        link = shown.split()[shown.split().index("live:") + 1]
        with urllib.request.urlopen(link, timeout=TIMEOUT_S) as page:
            assert b"<html" in page.read()
        if "up | pose valid" not in shown:
            text_until(process, r" *up \| pose valid")
        # 30 deg of heading and half a kilometer from the site would do: the filter's own tests are sharper
        status = json.loads(invoke(lcm_url, "status", "--json").stdout)
        assert status["localization"]["latitude_deg"] == pytest.approx(50.27, abs=0.005)
        assert status["localization"]["longitude_deg"] == pytest.approx(-111.18, abs=0.005)
        answer = json.loads(invoke(lcm_url, "query", "Cart:Antenna", "World:UTM", "--json").stdout)
        assert answer["geodetic"]["latitude_deg"] == pytest.approx(50.27, abs=0.005)
        running = list_running(emulated)
        assert set(running) == {"run", "driver gps", "driver imu", "emulate gps", "emulate imu"}
        os.kill(running["driver imu"], signal.SIGKILL)
        text_until(process, r" *up \| imu was killed by SIGKILL; it is restarted in 1 s")
        text_until(process, r" *imu \| .*receiving message")
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=TIMEOUT_S)
    finally:
        close(process)
    assert process.returncode == 0
    assert list_running(emulated) == {}
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(link, timeout=TIMEOUT_S)
    # the drivers ended in order while their devices were there
    assert re.search(r"gps \| .*closed: ended", rest)
    assert "restored" not in rest
    assert not (cart.parent / "state").exists()


def test_given_real_devices_that_are_missing_then_up_waits_for_them_and_ends_after_its_time(
    cart: Path, lcm_url: str
) -> None:
    process = start_up(cart, lcm_url, "--seconds", "9")
    try:
        out, _ = process.communicate(timeout=TIMEOUT_S)
    finally:
        close(process)
    assert process.returncode == 0, out
    assert "/dev/ttyGPS: there is no such port" in out
    assert "up | pose not valid: no usable GPS fix yet" in out
    assert not (cart.parent / "emulated").exists()


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("vehicle.yaml", VEHICLE.replace("channel: GPS", "chanel: GPS"), "nearest: channel"),
        ("vehicle.yaml", VEHICLE.partition("drivers:")[0], "no section drivers"),
        ("geometry.yaml", GEOMETRY.replace("Antenna", "Antena"), "Cart:Antena"),
        ("vehicle.yaml", None, "modelserver new writes one"),
    ],
)
def test_given_a_fault_in_a_file_then_nothing_is_started_and_the_fix_is_named(
    cart: Path, lcm_url: str, file: str, text: str | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if text is None:
        (cart.parent / file).unlink()
    else:
        (cart.parent / file).write_text(text)
    monkeypatch.chdir(cart.parent)
    found = invoke(lcm_url, "up", "--emulate")
    assert found.returncode == 1
    assert expected in found.stderr
    assert not (cart.parent / "emulated" / "state").exists()
    shutil.rmtree(cart.parent / "emulated", ignore_errors=True)


PLUGIN_DRIVER = """\
  radar: {device: speed, port: /dev/ttyRADAR, wheel: middle}
"""


def install_plugin(folder: Path, *entries: str) -> None:
    """Install a package with the examples of an own device and measurement, and the metadata that pip writes."""
    info = folder / "speed_device-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: speed-device\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("\n".join([*entries, ""]))
    shutil.copy(EXAMPLE, folder / "speed_device.py")
    shutil.copy(EXAMPLE.with_name("own_measurement.py"), folder / "radar_measurement.py")


def test_given_an_installed_device_then_it_is_found_checked_emulated_and_fused(
    cart: Path, tmp_path: Path, lcm_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    packages = tmp_path / "packages"
    install_plugin(
        packages,
        "[modelserver.drivers]",
        "speed = speed_device:KIND",
        "broken = no_such_module:KIND",
        "[modelserver.measurements]",
        "ground_radar = radar_measurement:RADAR",
        "lost = radar_measurement:Radar",
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(packages), *filter(None, [os.environ.get("PYTHONPATH")])]))
    wheels = 'sensors:\n  wheels: {frames: {middle: "Cart:Base"}}\n'
    wheels += "  aiding: {doppler: {type: ground_radar, channel: DOPPLER}}\n"
    cart.write_text(VEHICLE.replace("sensors:\n", wheels) + PLUGIN_DRIVER)

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*MODELSERVER, *arguments], capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )

    listed = run("driver", "--list")
    assert "speed            device of an installed package: speed sensor that sends $SPD" in listed.stdout
    assert "broken           device of an installed package, not usable: ModuleNotFoundError" in listed.stderr
    assert "ground_radar     measurement of an installed package: forward speed over ground, m/s" in listed.stdout
    assert "lost             measurement of an installed package, not usable: radar_measurement:Radar is a class" in (
        listed.stderr
    )
    checked = run("check", str(cart))
    assert (checked.returncode, "clean" in checked.stdout) == (0, True), checked.stdout
    cart.write_text(cart.read_text().replace("device: speed", "device: broken"))
    assert "of an installed package cannot be used: ModuleNotFoundError" in run("check", str(cart)).stdout
    cart.write_text(cart.read_text().replace("device: broken", "device: speed").replace("wheel:", "weel:"))
    assert "unknown key 'weel'" in run("check", str(cart)).stdout
    cart.write_text(cart.read_text().replace("weel:", "wheel:"))

    process = start_up(cart, lcm_url, "--emulate")
    try:
        text_until(process, r" *up \| pose valid")
        deadline = time.monotonic() + TIMEOUT_S
        while not count_used(lcm_url, "sensor:radar"):
            assert time.monotonic() < deadline, "no measurement of the radar was used"
        with ms.SensorPublisher("doppler", url=lcm_url, channels={"measurement": "DOPPLER"}) as publisher:
            while not count_used(lcm_url, "sensor:doppler"):
                assert time.monotonic() < deadline, "no measurement of the installed type was used"
                publisher.measurement([0.0], sigma=[5.0])
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=TIMEOUT_S)
        close(process)


def count_used(url: str, source: str) -> int:
    """Return how many measurements of a source the service has used by its next report."""
    status = json.loads(invoke(url, "status", "--json").stdout)
    return sum(each["used"] for each in status["channels"] if each["channel"] == source)
