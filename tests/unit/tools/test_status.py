"""`modelserver status`: the report as text, and the message where there is none."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_wire import EXAMPLES

from modelserver.core import DEGRADED, RUNNING, STARTING
from modelserver.messages import (
    ChannelHealth,
    DriverHealth,
    DriverPhase,
    Health,
    Invalid,
    LocalizationHealth,
    Mode,
    Phase,
)
from modelserver.wire.codec import encode
from mstools.commands import status
from mstools.terminal.health import (
    MAX_ROWS,
    as_data,
    format_clock,
    format_duration,
    format_report,
    is_healthy,
)

BARE, FULL = EXAMPLES["health_t"]
WELL: Health = replace(FULL, state=RUNNING)
DRIVERS: tuple[DriverHealth, ...] = EXAMPLES["driver_health_t"]


# --- in words -----------------------------------------------------------------------------------------------


def test_given_a_report_then_all_of_it_is_reported() -> None:
    text = format_report(WELL, DRIVERS[1:], ("gps", "imu"))
    for words in (
        "raptor: RUNNING, up 1 min 39 s; modelserver 0.1.0, process 4711 on raptor-pc",
        "valid",
        "protection level 1.50 m, heading 2.9 deg; 12.0 s to the limit",
        "mode no_gps, aligned, stationary; last fix used 300 ms ago",
        "epoch 2, origin ffffffffffffffb3, 4950 poses published",
        "revision ab12",
        "tick latency 0.10 / 0.50 / 1.00 / 2.00 ms",
        "12% of a CPU, 150 MB",
        "12 answered, 1 waiting for data, 3 queued",
        "journal: the disk is full",
        "never received",
        "streaming",
        "NO REPORT",
        "truncated",
    ):
        assert words in text, words


def test_given_a_pose_that_may_not_be_used_then_every_reason_is_reported_in_words() -> None:
    health = replace(WELL, state=DEGRADED, invalid_reasons=Invalid.STALE_GPS | Invalid.TILTED)
    text = format_report(health)
    assert "raptor: DEGRADED" in text
    assert "NOT VALID: the last usable GPS fix is too old; " in text


def test_given_a_place_then_it_is_shown() -> None:
    place = replace(DRIVING, latitude_deg=50.27, longitude_deg=-111.18, height=700.04, heading_deg=39.71)
    text = format_report(replace(WELL, localization=place))
    assert "at 50.2700000, -111.1800000 deg, height 700.0 m, heading 39.7 deg" in text
    text = format_report(replace(WELL, localization=replace(place, heading_deg=math.nan)))
    assert "height 700.0 m\n" in text


def test_given_a_report_in_which_little_is_known_then_no_number_is_made_up() -> None:
    text = format_report(BARE)
    assert "no localization sensor is configured" in text
    assert "nan" not in text
    assert "CPU load unknown, memory unknown" in text


IMU = ChannelHealth("sensor:imu", 500, 50.0, 0.01)
GPS = ChannelHealth("sensor:gps", 100, 10.0, 0.05)
NEVER_RECEIVED = (
    ChannelHealth("GPS", 0, 0.0, math.nan, math.nan, True),
    ChannelHealth("IMU", 0, 0.0, math.nan, math.nan, True),
)
QUIET = tuple(replace(each, rate_hz=0.0, age=9.0, silent=True) for each in (GPS, IMU))
LEVELING = LocalizationHealth(Mode.FULL, Phase.LEVELING)
DRIVING = LocalizationHealth(Mode.FULL, Phase.ALIGNED, False, 1.5, 0.05, 12.0, 0.3)
STALE = Invalid.STALE_IMU | Invalid.LIMIT_EXCEEDED


@pytest.mark.parametrize(
    ("output", "channels", "reasons", "filter_line", "bounds"),
    [
        (LEVELING, NEVER_RECEIVED, Invalid.NO_IMU,
         "mode full, leveling: no sensor sample received yet; no fix used yet", "protection levels unknown"),
        (LEVELING, (NEVER_RECEIVED[0], IMU), Invalid.NO_FIX,
         "mode full, leveling; no fix used yet", "protection levels unknown"),
        (replace(LEVELING, stationary=True), (GPS, IMU), Invalid.NO_FIX,
         "mode full, leveling, stationary; no fix used yet", "protection levels unknown"),
        (replace(LEVELING, phase=Phase.UNALIGNED), (GPS, IMU), Invalid.NOT_MOVED_YET,
         "mode full, unaligned, moving; no fix used yet", "protection levels unknown"),
        (DRIVING, (GPS, IMU), Invalid(0),
         "mode full, aligned, moving; last fix used 300 ms ago",
         "protection level 1.50 m, heading 2.9 deg; 12.0 s to the limit"),
        (replace(DRIVING, horizontal_level=1.0, heading_level=0.03, horizontal_limit=20.0, heading_limit=0.6),
         (GPS, IMU), Invalid(0),
         "mode full, aligned, moving", "level 1.00 of 20 m, heading 1.7 of 34 deg; protection level 1.50 m"),
        (DRIVING, (GPS, QUIET[1]), STALE,
         "mode full; aligned, moving at the last sensor sample; last fix used 300 ms ago", "protection level 1.50 m"),
        (replace(DRIVING, mode=Mode.NO_IMU), QUIET, Invalid.STALE_GPS,
         "mode no_imu; aligned, moving at the last sensor sample; last fix", "protection level"),
        (replace(DRIVING, mode=Mode.RAW, phase=None), (GPS, IMU), Invalid(0),
         "mode raw, no filter, moving; last fix", "protection level"),
        (replace(DRIVING, mode=Mode.RAW, phase=None), QUIET, STALE,
         "mode raw; no filter, moving at the last sensor sample; last fix", "protection level"),
        (replace(LEVELING, mode=Mode.RAW, phase=None), NEVER_RECEIVED, Invalid.NO_IMU,
         "mode raw, no filter: no sensor sample received yet; no fix", "protection levels unknown"),
        (DRIVING, NEVER_RECEIVED, Invalid.NO_IMU,
         "mode full, aligned: no sensor sample received yet; last fix used 300 ms ago", "protection level"),
        (replace(DRIVING, heading_protection_level=math.nan), (GPS, IMU), Invalid(0),
         "mode full", "protection level 1.50 m, heading unknown"),
        (replace(DRIVING, horizontal_protection_level=math.inf), (GPS, IMU), Invalid(0),
         "mode full", "protection level of position unknown, heading 2.9 deg"),
        (replace(DRIVING, fix_age=-3600.0), (GPS, IMU), Invalid(0),
         "last fix used has a stamp 1 h 00 min ahead of the clock", "protection level"),
    ],
)  # fmt: skip
def test_given_a_state_then_what_was_known_is_not_reported_as_if_it_were_so_now(
    output: LocalizationHealth,
    channels: tuple[ChannelHealth, ...],
    reasons: Invalid,
    filter_line: str,
    bounds: str,
) -> None:
    health = replace(WELL, localization=output, channels=channels, invalid_reasons=reasons)
    text = format_report(health)
    assert filter_line in text
    assert f"\n          {bounds}" in text
    assert not re.search(r"\b(level|heading) -", text)
    moving = "moving;" in filter_line or "stationary;" in filter_line
    current = as_data(health)["localization"]["current"]
    assert current == ("received yet" not in filter_line and "at the last" not in filter_line)
    assert current or not moving


def test_given_one_of_a_thing_then_the_words_are_of_one() -> None:
    one = replace(WELL, ticks_missed=1, handler_errors=1, poses_published=1, requests_waiting=1)
    for words in ("1 tick missed, 1 internal error", "1 pose published", "1 waiting for data"):
        assert words in format_report(one)
    several = replace(WELL, ticks_missed=3, handler_errors=0, poses_published=2, requests_waiting=2)
    for words in ("3 ticks missed, 0 internal errors", "2 poses published", "2 waiting for data"):
        assert words in format_report(several)


def test_given_a_silent_sensor_then_it_stands_out() -> None:
    silent = ChannelHealth("sensor:imu", 5, 0.0, 7.5, math.nan, True)
    assert "SILENT" in format_report(replace(WELL, channels=(silent,)))


def test_given_a_driver_that_is_not_well_then_its_phase_stands_out() -> None:
    assert "CLOSED" in format_report(WELL, DRIVERS[:1])
    assert DRIVERS[0].phase is DriverPhase.CLOSED


def test_given_words_of_a_stranger_then_they_are_escaped_and_endless_tables_are_cut() -> None:
    evil = "\x1b[2J\nEVIL"
    health = replace(
        WELL,
        host=evil,
        vehicle=evil,
        version=evil,
        channels=tuple(ChannelHealth(f"{evil}{n}", 1, 1.0, 1.0) for n in range(500)),
        rejected=tuple((evil, f"{evil}{n}", 1) for n in range(500)),
        warnings=((evil, evil),),
    )
    text = format_report(health, [replace(DRIVERS[1], source=evil, text=evil, link=evil)], [evil])
    assert all(each.isprintable() for each in text.split("\n"))
    assert f"and {500 - MAX_ROWS} more" in text
    assert "\nEVIL" not in text


@pytest.mark.parametrize(
    ("health", "is_well"),
    [
        (WELL, True),
        (replace(WELL, state=STARTING), False),
        (replace(WELL, state=DEGRADED), False),
        (replace(WELL, invalid_reasons=Invalid.NO_FIX), False),
        (replace(BARE, localization=LocalizationHealth()), True),
    ],
)
def test_given_a_report_then_it_is_well_or_not(health: Health, is_well: bool) -> None:
    assert is_healthy(health) is is_well


def test_given_a_report_for_scripts_then_it_is_json_with_names_and_nulls() -> None:
    data = json.loads(json.dumps(as_data(WELL, DRIVERS), allow_nan=False))
    assert (data["state"], data["healthy"], data["invalid_reasons"]) == ("RUNNING", True, 0)
    assert data["localization"]["mode"] == "NO_GPS"
    assert data["channels"][1]["age"] is None
    assert data["warnings"] == {"journal": "the disk is full"}
    assert [each["phase"] for each in data["drivers"]] == ["CLOSED", "STREAMING"]
    assert data["drivers"][1]["counters"]["bestpos"] == 450
    assert json.dumps(as_data(BARE), allow_nan=False)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 ms"),
        (0.0124, "12 ms"),
        (0.9996, "1.0 s"),
        (59.94, "59.9 s"),
        (61.0, "1 min 01 s"),
        (3_725.0, "1 h 02 min"),
        (180_000.0, "2 days 2 h"),
        (math.nan, "-"),
        (math.inf, "-"),
    ],
)
def test_given_a_time_then_it_is_reported_in_the_units_that_people_use(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text


@given(st.floats(), st.integers(-(1 << 63), (1 << 63) - 1))
def test_given_any_numbers_then_they_are_reported(seconds: float, utime: int) -> None:
    assert format_duration(seconds)
    assert format_clock(utime)


# --- nobody there -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("instead", "words"),
    [
        ({}, "The bus has no messages at all: is the daemon running (modelserver run -c FILE"),
        ({"GPS": False, "IMU": False}, "The bus has other channels ('GPS', 'IMU'): is the daemon running"),
        ({"A_MODELSERVER_HEALTH": True}, "Other reports: 'A_MODELSERVER_HEALTH'. Did you mean --prefix 'A_'?"),
        (
            {"RAPTOR_MODELSERVER_HEALTH": True, "HUSKY_MODELSERVER_HEALTH": True},
            "Did you mean --prefix 'HUSKY_'?",
        ),
        ({"MODELSERVER_HEALTH": True}, "Did you mean no --prefix?"),
        ({"HUSKI_MODELSERVER_HEALTH": False}, "another version"),
    ],
)
def test_given_no_report_then_it_reports_what_was_there_instead_and_what_to_do(
    instead: dict[str, bool], words: str
) -> None:
    text = status.format_no_report("udpm://x", "HUSKI_", 2.5, instead)
    assert text.startswith("no health report on HUSKI_MODELSERVER_HEALTH within 2.5 s, on udpm://x. ")
    assert words in text


def test_given_endless_channels_of_strangers_then_few_are_named_and_escaped() -> None:
    text = status.format_no_report("udpm://x", "", 2.5, {f"\x1b[2J{n:03}": False for n in range(500)})
    assert "499" not in text
    assert text.isprintable()


ALWAYS_READY = os.open(os.devnull, os.O_RDONLY)
"""`modelserver status`: the report as text, and the message where there is none."""


class FakeLcm:
    """Pass queued messages to the subscribers of their channels."""

    def __init__(self, *messages: tuple[str, bytes]):
        self.queue = list(messages)
        self.handlers: dict[str, Callable[[str, bytes], None]] = {}
        self._always_ready = ALWAYS_READY

    def subscribe(self, pattern: str, handler: Callable[[str, bytes], None]) -> None:
        self.handlers[pattern.removesuffix(r"\z")] = handler

    def fileno(self) -> int:
        return self._always_ready

    def handle_timeout(self, milliseconds: int) -> int:
        if not self.queue:
            return 0
        channel, data = self.queue.pop(0)
        handler = self.handlers.get(channel) or self.handlers.get(".*")
        if handler is not None:
            handler(channel, data)
        return 1


def test_given_reports_then_the_listener_knows_the_last_ones_and_passes_over_what_is_none() -> None:
    driver: Any = DRIVERS[1]
    bus = FakeLcm(
        ("A_MODELSERVER_HEALTH", b"rubbish"),
        ("A_MODELSERVER_HEALTH", encode(WELL)),
        ("A_DRIVER_HEALTH", b""),
        ("A_DRIVER_HEALTH", encode(driver)),
        ("MODELSERVER_HEALTH", encode(BARE)),
    )
    listener = status.HealthListener(bus, "A_")  # type: ignore[arg-type]
    assert listener.listen(10.0, lambda: listener.has_drivers(("gps",)))
    assert listener.health is not None
    assert (listener.health.state, listener.reports) == (RUNNING, 1)
    assert not listener.has_drivers(())
    assert not listener.has_drivers(("gps", "imu"))


def test_given_endless_drivers_of_a_stranger_then_so_many_are_retained() -> None:
    driver: Any = DRIVERS[1]
    reports = [("DRIVER_HEALTH", encode(replace(driver, source=f"d{n}"))) for n in range(status.MAX_NAMES + 9)]
    bus = FakeLcm(*reports)
    listener = status.HealthListener(bus, "")  # type: ignore[arg-type]
    assert listener.listen(60.0, lambda: not bus.queue)
    assert len(listener.drivers) == status.MAX_NAMES


def test_given_a_bus_then_what_is_there_instead_is_reported_with_whether_it_is_a_report() -> None:
    bus = FakeLcm(("B_MODELSERVER_HEALTH", encode(BARE)), ("X", b"12345678"))
    assert status.probe_channels(bus, 0.05) == {"B_MODELSERVER_HEALTH": True, "X": False}  # type: ignore[arg-type]


def test_given_a_report_then_the_status_has_how_many_measurements_were_used() -> None:
    wheels = ChannelHealth("sensor:wheels", 1230, 100.0, 0.01, measured=217, used=215)
    health = replace(WELL, channels=(IMU, wheels))
    (row,) = (line for line in format_report(health).splitlines() if "sensor:wheels" in line)
    assert "215/217" in row
    (data,) = (each for each in as_data(health)["channels"] if each["channel"] == "sensor:wheels")
    assert (data["measured"], data["used"]) == (217, 215)


# --- documented keys ------------------------------------------------------------------------------------------


def test_given_the_documented_keys_of_json_then_they_are_those_of_a_report() -> None:
    data = as_data(FULL, DRIVERS[1:])
    of = {"report": data, "`localization`": data["localization"], "`stability`": data["stability"]}
    of |= {f"`{name}[]`": data[name][0] for name in ("channels", "rejected", "drivers")}
    page = (Path(__file__).parents[3] / "docs" / "monitoring.md").read_text(encoding="utf-8")
    rows = dict(
        re.findall(r"^\| (\S+) \| (`[^|]+`) \|$", page.partition("| object | keys |")[2].partition("\n\n")[0], re.M)
    )
    assert rows.keys() == of.keys()
    for name, keys in rows.items():
        assert re.findall(r"`(\w+)`", keys) == list(of[name]), name
    # a report without values has the same keys
    bare = as_data(BARE)
    assert list(bare) == list(data)
    assert list(bare["localization"]) == list(data["localization"])
