"""Recordings of a line: what was kept comes again at its time, also from a damaged file."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.errors import RecordingError
from msdrivers.lines import CanForm, ModbusForm
from msdrivers.links import PlayedOutError
from msdrivers.links.fake import FakeLink, FakeTime
from msdrivers.protocol.can.frame import CanFrame
from msdrivers.protocol.modbus.registers import FailureKind, ModbusFailure, ReadRegisters, Registers, Table
from msdrivers.raw_log import BytesForm, PlayedLink, RawReader, RawWriter, RecordingLink, Way, open_for_reading


def recorded(limit: int = 1 << 20) -> tuple[str, RawWriter]:
    time = FakeTime()
    start = time.monotonic_ns * 1e-9
    stream = io.StringIO()
    writer = RawWriter(stream, limit)
    writer.begin("bytes", "gps", "novatel")
    units = [(start + 0.5, b"one"), (start + 0.75, b"two"), (start + 3.0, b"\x00\xff")]
    link = RecordingLink(FakeLink(time, units), BytesForm(), writer, time)
    link.open(38400)
    link.send(b"log")
    while time.monotonic_ns * 1e-9 < start + 4.0:
        link.poll(0.2)
    link.close()
    return stream.getvalue(), writer


def test_given_a_line_when_recorded_then_all_of_it_stands_there_with_times() -> None:
    text, _ = recorded()
    reader = RawReader(io.StringIO(text), "x")
    records = list(reader)
    assert (reader.kind, reader.source, reader.device, reader.damaged) == ("bytes", "gps", "novatel", 0)
    assert [(record.way, record.data) for record in records] == [
        (Way.WORD, b"open fake 38400"),
        (Way.SENT, b"log"),
        (Way.RECEIVED, b"one"),
        (Way.RECEIVED, b"two"),
        (Way.RECEIVED, b"\x00\xff"),
        (Way.WORD, b"close"),
    ]
    received = [record.now for record in records if record.way is Way.RECEIVED]
    assert received[1].utime - received[0].utime == 250_000
    assert received[1].monotonic_ns - received[0].monotonic_ns == 250_000_000


def test_given_a_recording_when_played_then_units_come_as_long_after_each_other_and_then_it_ends() -> None:
    text, _ = recorded()
    time = FakeTime(monotonic_ns=77_000_000_000)
    link = PlayedLink("x", RawReader(io.StringIO(text), "x"), BytesForm().unpack, time)
    link.open()
    heard = []
    while len(heard) < 3:
        heard += [(time.monotonic_ns, unit) for unit in link.poll(0.2)]
        link.send(b"goes nowhere")
    with pytest.raises(PlayedOutError):
        link.poll(0.2)
    assert heard == [(77_000_000_000, b"one"), (77_250_000_000, b"two"), (79_500_000_000, b"\x00\xff")]


@given(st.integers(0, 400))
def test_given_a_recording_cut_anywhere_then_all_before_is_read(length: int) -> None:
    text, _ = recorded()
    cut = text[: min(length, len(text))]
    try:
        records = list(RawReader(io.StringIO(cut), "x"))
    except RecordingError:
        assert "\n" not in cut
        return
    assert len(records) == max(0, cut.count("\n") - 1)


def test_given_damaged_lines_then_they_are_counted_and_the_others_read() -> None:
    text, _ = recorded()
    lines = text.splitlines(keepends=True)
    lines[3:3] = ["< 1 2 zz\n", "nonsense\n", "? 1 2 00\n", "< x 2 00\n", "\n"]
    reader = RawReader(io.StringIO("".join(lines)), "x")
    assert len(list(reader)) == 6
    assert reader.damaged == 5


def test_given_a_limit_then_the_recording_is_no_larger_and_whole() -> None:
    text, writer = recorded(limit=150)
    assert len(text) <= 150
    assert writer.full
    assert text.endswith("\n")
    assert len(list(RawReader(io.StringIO(text), "x"))) >= 1


@pytest.mark.parametrize("text", ["", "hello\n", "# modelserver raw 2 bytes a b\n", "# modelserver raw 1 bytes\n"])
def test_given_another_file_then_it_is_no_recording(text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.raw"
    path.write_text(text)
    with pytest.raises(RecordingError, match="no recording of a driver"):
        open_for_reading(path)


@pytest.mark.parametrize(
    "frame",
    [CanFrame(0x123, b"\x01\x02"), CanFrame(0x1FFFFFFF, b"", is_extended=True), CanFrame(0x40, is_error=True)],
)
def test_given_a_can_frame_then_its_form_keeps_all_of_it(frame: CanFrame) -> None:
    assert CanForm().unpack(CanForm().pack(frame)) == frame


@pytest.mark.parametrize(
    "unit",
    [
        ReadRegisters(5, 3, Table.INPUT, 77),
        Registers(5, (1, 65535), 77),
        ModbusFailure(FailureKind.EXCEPTION, "no such register", 2, 77),
    ],
)
def test_given_a_modbus_unit_then_its_form_keeps_all_of_it(unit: ReadRegisters | Registers | ModbusFailure) -> None:
    assert ModbusForm().unpack(ModbusForm().pack(unit)) == unit


@given(st.binary(max_size=40))
def test_given_any_bytes_then_a_form_refuses_or_takes_them(data: bytes) -> None:
    for form in (CanForm(), ModbusForm()):
        try:
            form.unpack(data)
        except ValueError:
            continue
