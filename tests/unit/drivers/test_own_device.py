"""The example of a new device: it runs, stays short, and does what docs/own-device.md describes."""

from __future__ import annotations

import math
import runpy
import subprocess
import sys
from dataclasses import replace
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.messages import DriverPhase, Sample, SensorHeader, WheelSample, WheelsSample
from msdrivers.devices.stream import FrameScanner
from msdrivers.emulate import InjectedFault
from msdrivers.endpoint import HostTime, Send
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.registry import KINDS, EmulatorInputs, make_registry
from msdrivers.runner import Runner, RunnerSettings
from msdrivers.settings import read_driver

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "examples" / "python" / "own_device.py"
OWN: dict[str, Any] = runpy.run_path(str(EXAMPLE))
START_US = 1_700_000_000_000_000


def _samples(*speeds: float) -> list[WheelsSample]:
    stamps = (START_US + 100_000 * number for number in range(1, len(speeds) + 1))
    return [
        WheelsSample(SensorHeader(stamp, "radar", seq), (WheelSample("speed", speed=speed),))
        for seq, (stamp, speed) in enumerate(zip(stamps, speeds, strict=True))
    ]


def _run_emulator(unit: Any) -> list[tuple[float, bytes]]:
    """Return the output of the emulated device, with the seconds of the monotonic clock."""
    monotonic_ns, coming = 1_000_000_000, []
    unit.on_open(HostTime(monotonic_ns, START_US))
    while (due := unit.get_deadline()) is not None:
        now = HostTime(due, START_US + (due - monotonic_ns) // 1000)
        coming += [(due * 1e-9, each.unit) for each in unit.on_timer(now) if isinstance(each, Send)]
    return coming


def _run_driver(
    coming: list[tuple[float, bytes]], seconds: float
) -> tuple[Runner[bytes], list[Sample], FakeTimeSource]:
    time, published = FakeTimeSource(START_US), list[Sample]()
    driver = OWN["SpeedDriver"](OWN["SpeedSettings"]("radar"))
    runner = Runner(driver, FakeLink(time, coming), RunnerSettings("radar", "speed"), time, published.append)
    while time.monotonic_ns < round((1.0 + seconds) * 1e9):
        runner.run_once()
    return runner, published, time


def _speeds(samples: list[Sample]) -> list[float]:
    return [each.wheels[0].speed for each in samples if isinstance(each, WheelsSample)]


def test_given_the_example_then_it_runs_and_is_short() -> None:
    done = subprocess.run([sys.executable, EXAMPLE], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "speed=1.23" in done.stdout
    assert "speed=1.25" in done.stdout
    assert "('rejected.checksum', 1)" in done.stdout
    assert "SILENT" in done.stdout
    code = [line for line in EXAMPLE.read_text(encoding="utf-8").splitlines() if line.strip()]
    assert len(code) < 120


def test_given_driver_and_emulator_on_one_line_then_the_speeds_arrive_with_their_instants() -> None:
    unit = OWN["KIND"].make_emulator(EmulatorInputs(None, ROOT, _samples(1.0, -0.5, 2.25)))
    _, published, _ = _run_driver(_run_emulator(unit), 0.5)
    assert _speeds(published) == [1.0, -0.5, 2.25]
    # without a device time: the receive time minus the configured delay
    assert [each.header.utime for each in published] == [START_US + 1000 * ms for ms in (70, 170, 270)]
    assert all(math.isclose(each.header.utime_sigma, 0.01) for each in published)


def test_given_a_damaged_line_then_it_is_counted_and_the_next_one_taken() -> None:
    unit = OWN["KIND"].make_emulator(
        EmulatorInputs(None, ROOT, _samples(1.0, 2.0, 3.0), (InjectedFault(0.15, "corrupt", 1.0),))
    )
    runner, published, time = _run_driver(_run_emulator(unit), 0.5)
    assert _speeds(published) == [1.0, 3.0]
    counters = dict(runner.make_health(time.now()).counters)
    assert sum(count for name, count in counters.items() if name.startswith("rejected.")) == 1


@pytest.mark.parametrize("line", ["SPD,nan", "SPD,inf", "SPD,1e9", "SPD,1_0", "SPD, 1.00", "1.00", "SPD,", "XYZ,1.00"])
def test_given_a_line_that_is_right_by_its_checksum_alone_then_it_is_rejected(line: str) -> None:
    body = line.encode()
    scanner = FrameScanner[float]([OWN["SpeedFormat"]()])
    assert scanner.feed(b"$%b*%02X\r\n" % (body, reduce(xor, body))) == []
    assert scanner.counts["rejected.content"] == 1


class FakeEntryPoint:
    """An entry point of an installed package."""

    def __init__(self, name: str, found: object):
        self.name, self.value, self._found = name, f"package:{name}", found

    def load(self) -> object:
        if isinstance(self._found, Exception):
            raise self._found
        return self._found


def test_given_entry_points_then_those_that_can_be_used_are_devices_and_the_others_have_a_reason() -> None:
    kind = OWN["KIND"]
    entries = [
        FakeEntryPoint("speed", kind),
        FakeEntryPoint("broken", ImportError("no module")),
        FakeEntryPoint("number", 5),
        FakeEntryPoint("other_name", kind),
        FakeEntryPoint("gx1", replace(kind, name="gx1")),
    ]
    registry = make_registry([KINDS["gx1"]], lambda: entries)
    assert registry["gx1"] is KINDS["gx1"]
    assert dict(registry) == {"gx1": KINDS["gx1"], "speed": kind}
    assert registry.plugins == {"speed": kind}
    assert {name: why[:12] for name, why in registry.problems.items()} == {
        "broken": "ImportError:",
        "number": "package:numb",
        "other_name": "package:othe",
        "gx1": "there is one",
    }
    assert "nothing" not in registry


def test_given_silence_then_it_is_reported_and_ends_with_the_next_speed() -> None:
    unit = OWN["KIND"].make_emulator(EmulatorInputs(None, ROOT, _samples(1.0)))
    coming = [*_run_emulator(unit), (4.0, OWN["encode_speed"](2.0))]
    runner, _, time = _run_driver(coming, 2.0)
    report = runner.make_health(time.now())
    assert report.phase is DriverPhase.SILENT
    assert "no $SPD for 1 s" in report.text
    while time.monotonic_ns < 4_100_000_000:
        runner.run_once()
    assert runner.make_health(time.now()).phase is DriverPhase.STREAMING


def test_given_a_section_of_the_vehicle_file_then_its_settings_are_read() -> None:
    section = {"device": "speed", "port": "/dev/ttyUSB2", "wheel": "speed", "delay": 0.02}
    settings = read_driver("radar", section, kinds={**KINDS, "speed": OWN["KIND"]})
    assert settings.device_settings == OWN["SpeedSettings"]("radar", delay=0.02)


@given(st.lists(st.one_of(st.binary(max_size=40), st.just(OWN["encode_speed"](1.5))), max_size=8), st.integers(1, 20))
def test_given_any_bytes_then_pieces_give_the_same_as_the_whole(parts: list[bytes], size: int) -> None:
    data = b"".join(parts)
    whole, pieces = (FrameScanner[float]([OWN["SpeedFormat"]()]) for _ in range(2))
    expected = whole.feed(data)
    got = [speed for at in range(0, len(data), size) for speed in pieces.feed(data[at : at + size])]
    assert got == pytest.approx(expected, nan_ok=True)
    assert pieces.counts == whole.counts
    assert pieces.pending_bytes <= OWN["MAX_FRAME_LENGTH"]
