"""The spy in the terminal: statistics, formatted messages, keys; hostile texts cannot control it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_wire import EXAMPLES

import mslcm
from modelserver.errors import ModelServerError
from modelserver.wire.codec import encode
from modelserver.wire.encoded import type_name_of
from mstools.spy import fields as spy_types
from mstools.spy import terminal as spy_terminal
from mstools.spy.fields import (
    MAX_ENTRIES,
    MAX_LINES,
    MAX_NUMBERS,
    MAX_TEXT,
    Constants,
    constants_of,
    format_fields,
    format_value,
    load_constants,
)
from mstools.spy.terminal import (
    BusListener,
    KeyBinding,
    SpyView,
    format_message,
    format_rows,
    format_summary,
    is_decodable,
    parse_keys,
    print_once,
    render,
)
from mstools.spy.traffic import MAX_CHANNELS, MAX_CHECKS_PER_S, BusTraffic, ChannelStatistics

POSE = encode(EXAMPLES["pose_transform_t"][0])
HEALTH = encode(EXAMPLES["health_t"][1])


def traffic() -> BusTraffic:
    return BusTraffic(100.0, type_name_of, is_decodable)


# --- counting -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hz", [0.5, 4.0, 50.0, 200.0])
@pytest.mark.parametrize("seconds", [8.0, 21.3])
def test_given_a_steady_channel_then_its_rate_size_and_jitter_are_right(hz: float, seconds: float) -> None:
    statistics = traffic()
    for n in range(round(hz * seconds)):
        statistics.add("POSE", POSE, 100.0 + n / hz)
    now = 100.0 + seconds
    seen = statistics.channels["POSE"]
    rate, flow = statistics.get_rates(seen, now)
    assert rate == pytest.approx(hz, rel=0.03, abs=0.25)
    assert flow == pytest.approx(rate * len(POSE))
    assert (seen.type_name, seen.size, seen.undecodable) == ("pose_transform_t", len(POSE), 0)
    assert seen.jitter == pytest.approx(0.0, abs=1e-6)


def test_given_a_channel_that_falls_silent_then_its_rate_goes_to_0_and_its_memory_is_bounded() -> None:
    statistics = traffic()
    for n in range(10_000):
        statistics.add("X", b"", 100.0 + n * 0.01)
    assert len(statistics.channels["X"].buckets) <= 11
    assert statistics.get_rates(statistics.channels["X"], 206.0) == (0.0, 0.0)


def test_given_uneven_intervals_then_the_jitter_is_their_scatter() -> None:
    statistics = traffic()
    at = 100.0
    for n in range(2000):
        at += 0.015 if n % 2 else 0.005
        statistics.add("X", b"", at)
    assert statistics.channels["X"].jitter == pytest.approx(0.005, rel=0.2)


def test_given_one_message_then_there_is_no_jitter_yet() -> None:
    statistics = traffic()
    statistics.add("X", b"", 100.0)
    assert math.isnan(statistics.channels["X"].jitter)


def test_given_damaged_messages_of_ours_and_strangers_then_only_ours_count_as_bad() -> None:
    statistics = traffic()
    statistics.add("POSE", POSE[:-3], 100.1)
    statistics.add("POSE", POSE, 100.2)
    statistics.add("POSE", POSE + b"x", 100.3)
    statistics.add("OTHER", b"\x00\x01", 100.4)
    assert (statistics.channels["POSE"].undecodable, statistics.channels["OTHER"].undecodable) == (2, 0)
    assert statistics.channels["OTHER"].type_name == ""


def test_given_a_flood_then_only_so_many_messages_a_second_are_decoded() -> None:
    checked = []
    statistics = BusTraffic(100.0, type_name_of, lambda name, data: checked.append(name) is not None)
    for n in range(5 * MAX_CHECKS_PER_S):
        statistics.add("POSE", POSE, 100.0 + n * 1e-5)
    assert len(checked) == MAX_CHECKS_PER_S
    statistics.add("POSE", POSE, 101.0)
    assert len(checked) == MAX_CHECKS_PER_S + 1


def test_given_endless_channels_then_so_many_are_reported_apart_and_the_rest_is_counted() -> None:
    statistics = traffic()
    for n in range(MAX_CHANNELS + 300):
        statistics.add(f"C{n}", b"", 100.0)
        statistics.add("C0", b"", 100.0)
    assert (len(statistics.channels), statistics.others) == (MAX_CHANNELS, 300)
    assert "300 messages on further channels" in format_summary(statistics, 101.0)


# --- the names of numbers -----------------------------------------------------------------------------------


def test_given_the_files_of_the_types_then_fields_get_the_constants_before_them() -> None:
    found = load_constants()
    assert found["health_t", "state"].describe(2) == "2 DEGRADED"
    assert found["gps_t", "fix_type"].describe(5) == "5 FIX_RTK_FIXED"
    assert found["imu_t", "yaw_source"].describe(1) == "1 YAW_MAGNETIC"
    assert found["reply_header_t", "status"].describe(11) == "11 FORBIDDEN"
    assert (
        found["wheel_t" if ("wheel_t", "direction") in found else "wheels_t", "direction"].describe(-1) == "-1 BACKWARD"
    )
    flags = found["pose_transform_t", "invalid_reasons"]
    assert flags.are_bits
    assert flags.describe(33) == "33 (no usable fix yet; the last usable fix is too old)"
    assert found["pose_transform_t", "quality_flags"].describe(0) == "0"


@pytest.mark.parametrize(
    ("where", "value", "expected"),
    [
        (("health_t", "invalid_reasons"), 2, "2 (no inertial sample yet)"),
        (("localization_health_t", "mode"), 4, "4 NO_GPS"),
        (("localization_health_t", "phase"), 2, "2 ALIGNED"),
        (("navigation_state_t", "mode"), 1, "1 RAW"),
    ],
)
def test_given_a_comment_that_names_another_type_then_its_constants_count(
    where: tuple[str, str], value: int, expected: str
) -> None:
    assert load_constants()[where].describe(value) == expected


def test_given_numbers_that_have_no_name_then_it_is_reported_so() -> None:
    assert Constants({1: "ONE"}).describe(7) == "7 (unknown)"
    assert Constants({1: "ONE", 2: "TWO"}, {}, True).describe(1 + 8) == "9 (ONE; unknown bits 0x8)"
    assert Constants({1: "ONE"}, {}, True).describe(-1).startswith("-1 (ONE; unknown bits")


@given(st.text())
def test_given_any_text_for_a_type_then_nothing_breaks(text: str) -> None:
    constants_of({"x_t": text, "y_t": f"// as in x_t\nconst int8_t A = 1;\n{text}"})


def test_given_no_files_then_numbers_stay_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> tuple[Path, ...]:
        raise OSError

    monkeypatch.setattr(spy_types, "find_type_files", missing)
    load_constants.cache_clear()
    try:
        assert load_constants() == {}
    finally:
        load_constants.cache_clear()


# --- fields -------------------------------------------------------------------------------------------------


def decode_empty(type_name: str, number: int = 1) -> Any:
    examples = EXAMPLES[type_name]
    return getattr(mslcm, type_name).decode(encode(examples[min(number, len(examples) - 1)], type_name))


@pytest.mark.parametrize("type_name", sorted(EXAMPLES))
@pytest.mark.parametrize("number", [0, 1])
def test_given_a_message_of_any_type_then_every_field_is_reported_in_lines_that_a_terminal_can_take(
    type_name: str, number: int
) -> None:
    message = decode_empty(type_name, number)
    lines = format_fields(message, load_constants())
    assert all(line.isprintable() for line in lines)
    text = "\n".join(lines)
    assert all(name in text for name in message.__slots__ if getattr(message, name) not in ([], ()))


def test_given_a_health_report_then_its_parts_are_reported_nested_with_names_and_times() -> None:
    lines = format_fields(decode_empty("health_t"), load_constants())
    assert any(line.startswith("state ") and line.endswith("1 RUNNING") for line in lines)
    assert any(line.startswith("utime ") and line.endswith(" UTC)") for line in lines)
    at = lines.index("channels[0]")
    assert lines[at + 1].split() == ["channel", "'sensor:gps'"]
    assert any(line.split() == ["warning_texts", "['the", "disk", "is", "full']"] for line in lines)


def test_given_a_pose_then_the_matrix_has_its_rows_and_the_covariance_is_cut() -> None:
    lines = format_fields(decode_empty("pose_transform_t", 0), load_constants())
    at = next(n for n, line in enumerate(lines) if line.startswith("h_transform"))
    assert [line.strip().removeprefix("h_transform").strip()[0] for line in lines[at : at + 4]] == ["["] * 4
    assert any("... (36)]" in line for line in lines)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("x", b"", "0 bytes "),
        ("x", b"\x1b" * 20, f"20 bytes {' '.join(['1b'] * 16)}..."),
        ("x", "\x1b[2J\n", r"'\x1b[2J\n'"),
        ("x", "y" * 500, f"'{'y' * MAX_TEXT}'... (500 characters)"),
        ("x", True, "true"),
        ("x", math.nan, "nan"),
        ("x", [math.nan] * 36, "nan (36)"),
        ("x", [1, 2], "[1, 2]"),
        ("x", [], "[]"),
        ("x", list(range(20)), f"[{', '.join(map(str, range(MAX_NUMBERS)))}, ... (20)]"),
        ("utime", 0, "0"),
        ("host_utime", 1_700_000_000_123_456, "1700000000123456 (2023-11-14 22:13:20.123456 UTC)"),
        ("utime", -(1 << 63), str(-(1 << 63))),
        ("utime", (1 << 63) - 1, str((1 << 63) - 1)),
    ],
)
def test_given_a_value_then_it_is_reported_short_and_escaped(name: str, value: object, expected: str) -> None:
    assert format_value(name, value) == expected


def test_given_long_lists_of_structures_then_they_are_cut_and_the_lines_bounded() -> None:
    message = decode_empty("health_t")
    message.channels = message.channels * 400
    message.num_channels = len(message.channels)
    lines = format_fields(message, load_constants())
    assert f"... and {len(message.channels) - MAX_ENTRIES} more of channels" in lines
    message.rejected = [message] * 50
    assert len(format_fields(message, load_constants())) <= MAX_LINES + 1


@given(st.binary(max_size=400), st.sampled_from(sorted(EXAMPLES)))
def test_given_any_bytes_then_what_is_shown_of_them_is_bounded_and_printable(data: bytes, type_name: str) -> None:
    fingerprint = getattr(mslcm, type_name)._get_packed_fingerprint()
    for each in (data, fingerprint + data):
        seen = ChannelStatistics("X", type_name_of(each), 1, 0, len(each), each)
        lines = format_message(seen)
        assert lines
        assert all(line.isprintable() and len(line) < 5000 for line in lines)


# --- pictures -----------------------------------------------------------------------------------------------


def busy() -> BusTraffic:
    statistics = traffic()
    for n in range(30):
        statistics.add("POSE", POSE, 100.0 + n * 0.02)
        statistics.add("MODELSERVER_HEALTH", HEALTH, 100.0 + n * 0.02)
        statistics.add(f"Z{n}", b"", 100.0)
    statistics.add("\x1b[2J\nEVIL" + "X" * 50, b"\x1b", 100.0)
    return statistics


def test_given_traffic_then_the_rows_are_by_name_and_escaped() -> None:
    found = format_rows(busy(), 100.6)
    assert [row[0] for row in found] == [r"\x1b[2J\nEVILXXXXXXXXXXXXXXXXXXXXXXXXX..."[:37] + "...", *[
        row[0] for row in found[1:]
    ]]  # fmt: skip
    assert all(cell.isprintable() for row in found for cell in row)
    assert all(len(row) == len(spy_terminal.HEADER) for row in found)


@pytest.mark.parametrize("height", [1, 5, 24, 60, 200])
@pytest.mark.parametrize("channel", ["POSE", "MODELSERVER_HEALTH", "Z29", "GONE", ""])
@pytest.mark.parametrize("is_open", [True, False])
def test_given_a_terminal_of_any_height_then_the_picture_fits_and_has_the_chosen_channel(
    height: int, channel: str, is_open: bool
) -> None:
    statistics = busy()
    lines = render(statistics, SpyView(channel, is_open), 100.6, height).plain.split("\n")
    assert len(lines) <= max(height, 9)
    assert all(line.isprintable() for line in lines)
    if channel in statistics.channels:
        assert any(line.split()[:1] == [channel] for line in lines)


def test_given_nothing_received_then_the_picture_reports_0_channels() -> None:
    assert "0 channels" in render(traffic(), SpyView(), 101.0, 24).plain


NAMES = ["A", "B", "C", "D"]


@pytest.mark.parametrize(
    ("view", "key", "expected"),
    [
        (SpyView("B"), KeyBinding.DOWN, SpyView("C")),
        (SpyView("B"), KeyBinding.UP, SpyView("A")),
        (SpyView("A"), KeyBinding.UP, SpyView("A")),
        (SpyView("D"), KeyBinding.DOWN, SpyView("D")),
        (SpyView("A"), KeyBinding.PAGE_DOWN, SpyView("C")),
        (SpyView("D"), KeyBinding.PAGE_UP, SpyView("B")),
        (SpyView("B"), KeyBinding.END, SpyView("D")),
        (SpyView("B"), KeyBinding.HOME, SpyView("A")),
        (SpyView("B"), KeyBinding.ENTER, SpyView("B", True)),
        (SpyView("B", True), KeyBinding.ENTER, SpyView("B")),
        (SpyView("B", True), KeyBinding.BACK, SpyView("B")),
        (SpyView("GONE"), KeyBinding.DOWN, SpyView("B")),
        (SpyView("B"), KeyBinding.QUIT, None),
    ],
)
def test_given_a_key_then_the_view_follows(view: SpyView, key: KeyBinding, expected: SpyView | None) -> None:
    assert view.handle_key(key, NAMES, 2) == expected


def test_given_no_channels_then_keys_do_no_harm() -> None:
    assert all(SpyView().handle_key(key, [], 3) is not None for key in KeyBinding if key is not KeyBinding.QUIT)


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"\x1b[A\x1b[B", [KeyBinding.UP, KeyBinding.DOWN]),
        (b"\x1bOA", [KeyBinding.UP]),
        (b"\r", [KeyBinding.ENTER]),
        (b"q", [KeyBinding.QUIT]),
        (b"jjk", [KeyBinding.DOWN, KeyBinding.DOWN, KeyBinding.UP]),
        (b"\x1b", [KeyBinding.BACK]),
        (b"\x1b[5~\x1b[6~\x1b[1~\x1b[F", [KeyBinding.PAGE_UP, KeyBinding.PAGE_DOWN, KeyBinding.HOME, KeyBinding.END]),
        (b"xyz\x1b[99;5u", []),
        (b"", []),
    ],
)
def test_given_bytes_of_a_terminal_then_the_keys_in_them_are_found(data: bytes, expected: list[KeyBinding]) -> None:
    assert list(parse_keys(data)) == expected


@given(st.binary())
def test_given_any_bytes_of_a_terminal_then_nothing_breaks(data: bytes) -> None:
    assert len(parse_keys(data)) <= len(data)


# --- listening ----------------------------------------------------------------------------------------------


class FakeLcm:
    """Hands over what is queued, one message a call."""

    def __init__(self, *messages: tuple[str, bytes]):
        self.queue = list(messages)
        self.handler: Callable[[str, bytes], None] | None = None

    def subscribe(self, pattern: str, handler: Callable[[str, bytes], None]) -> FakeLcm:
        assert pattern == ".*"
        self.handler = handler
        return self

    def set_queue_capacity(self, count: int) -> None:
        assert count == 0

    def fileno(self) -> int:
        return -1

    def handle_timeout(self, milliseconds: int) -> int:
        if not self.queue or self.handler is None:
            return 0
        self.handler(*self.queue.pop(0))
        return 1


def test_given_messages_when_printed_once_then_table_and_fields_come(capsys: pytest.CaptureFixture[str]) -> None:
    listener = BusListener(FakeLcm(("POSE", POSE), ("\x1b[2J", b"x")))  # type: ignore[arg-type]
    listener.drain(math.inf)
    print_once(listener, 0.0, "POSE")
    out = capsys.readouterr().out
    assert "2 channels" in out
    assert "frame_of_interest" in out
    assert "\x1b" not in out


def test_given_a_channel_that_is_silent_when_printed_once_then_the_nearest_is_offered() -> None:
    listener = BusListener(FakeLcm(("POSE", POSE)))  # type: ignore[arg-type]
    listener.drain(math.inf)
    with pytest.raises(ModelServerError, match="no message on 'POZE'; nearest: 'POSE'"):
        print_once(listener, 0.0, "POZE")


def test_given_a_flood_then_taking_ends_with_its_time() -> None:
    listener = BusListener(FakeLcm(*[("X", b"")] * 1000))  # type: ignore[arg-type]
    listener.drain(time.monotonic() - 1.0)
    assert listener.traffic.channels["X"].count == 1


def test_given_nothing_when_printed_once_then_it_reports_what_to_look_at(capsys: pytest.CaptureFixture[str]) -> None:
    print_once(BusListener(FakeLcm()), 0.0)  # type: ignore[arg-type]
    assert "modelserver doctor" in capsys.readouterr().out
