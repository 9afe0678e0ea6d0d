"""UBX logs of u-blox receivers compared with gpsd's reports: time, position, height, speed, climb."""

from __future__ import annotations

from pathlib import Path

import pytest
from support_gps import Line, now_at

from modelserver.messages import FixType
from msdrivers.devices.ublox import UbloxDriver, UbloxSettings
from msdrivers.emulate.gps import UbloxEmulator
from tests.realdata.test_gpsd import reports, utime

pytestmark = pytest.mark.realdata

LOGS = {
    "ublox-lea-m8f": 0,  # it knows its place and measures the time only: fixes of type none
    "ublox-neo-f9v": 3,
    "ublox-neo-m8n": 22,
    "ublox-neo-m8u-hnr": 0,  # one epoch
    "ublox-zed-f9p-sfrbx": 18,
    "ublox-zed-f9t-ubx_nmea_l5": 8,
}
"""Logs with NAV-PVT, and the fewest epochs that gpsd reports too: it reports none before it knows the leap seconds."""


@pytest.mark.parametrize("name", LOGS)
def test_given_a_log_then_its_fixes_are_those_that_gpsd_reports(data_dir: Path, name: str) -> None:
    path = data_dir / "gpsd" / f"{name}.log"
    line = Line(UbloxDriver(UbloxSettings("gps")), UbloxEmulator(()))
    line.from_driver(line.driver.on_open(now_at(line.utime)))
    line.deliver(path.read_bytes())
    line.run(0.5)
    found = {sample.header.device_utime: sample for sample in line.samples}
    assert line.driver.counts["ubx.NAV-PVT"] == len(line.samples) + line.driver.counts.get("repeated", 0)
    compared = 0
    for report in reports(path.with_suffix(".log.chk")):
        if "time" not in report or "lat" not in report:
            continue
        when = utime(report)
        sample = next((each for at, each in found.items() if abs(at - when) < 2000), None)
        if sample is None or sample.fix_type is FixType.NONE:
            continue
        compared += 1
        place = (sample.latitude_deg, sample.longitude_deg)
        # gpsd's last digit is a nanodegree, of NMEA in the same log 1e-7 minutes
        assert place == pytest.approx((report["lat"], report["lon"]), abs=2e-6)
        if "altHAE" in report:
            assert sample.height_ellipsoidal == pytest.approx(report["altHAE"], abs=0.5)
        if "speed" in report:
            assert sample.speed == pytest.approx(report["speed"], abs=0.05)
    assert compared >= LOGS[name]
