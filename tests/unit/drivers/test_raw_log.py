"""Recordings of a line: what was kept comes again at its time, also from a damaged file."""

from __future__ import annotations

import io
import logging
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.errors import RecordingError
from msdrivers.endpoint import CanFrame, FailureKind, HostTime, ModbusFailure, ReadRegisters, Registers, RegisterTable
from msdrivers.links import EndOfRecordingError, LinkError
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.raw_log import (
    BYTES_CODEC,
    RawReader,
    RawWriter,
    RecordDirection,
    RecordingLink,
    ReplayLink,
    open_for_reading,
    open_for_writing,
)
from msdrivers.settings import CAN_CODEC, MODBUS_CODEC


def make_recording(limit: int = 1 << 20) -> tuple[str, RawWriter]:
    time = FakeTimeSource()
    start = time.monotonic_ns * 1e-9
    stream = io.StringIO()
    writer = RawWriter(stream, limit, "x")
    writer.begin("bytes", "gps", "novatel")
    units = [(start + 0.5, b"one"), (start + 0.75, b"two"), (start + 3.0, b"\x00\xff")]
    link = RecordingLink(FakeLink(time, units), BYTES_CODEC, writer, time)
    link.open(38400)
    link.send(b"log")
    while time.monotonic_ns * 1e-9 < start + 4.0:
        link.poll(0.2)
    link.close()
    return stream.getvalue(), writer


def test_given_a_line_when_recorded_then_all_of_it_stands_there_with_times() -> None:
    text, _ = make_recording()
    reader = RawReader(io.StringIO(text), "x")
    records = list(reader)
    assert (reader.kind, reader.source, reader.device, reader.damaged) == ("bytes", "gps", "novatel", 0)
    assert [(record.direction, record.data) for record in records] == [
        (RecordDirection.EVENT, b"open fake 38400"),
        (RecordDirection.SENT, b"log"),
        (RecordDirection.RECEIVED, b"one"),
        (RecordDirection.RECEIVED, b"two"),
        (RecordDirection.RECEIVED, b"\x00\xff"),
        (RecordDirection.EVENT, b"close"),
    ]
    received = [record.time for record in records if record.direction is RecordDirection.RECEIVED]
    assert received[1].utime - received[0].utime == 250_000
    assert received[1].monotonic_ns - received[0].monotonic_ns == 250_000_000


def test_given_a_recording_when_played_then_units_come_as_long_after_each_other_and_then_it_ends() -> None:
    text, _ = make_recording()
    time = FakeTimeSource(monotonic_ns=77_000_000_000)
    link = ReplayLink(RawReader(io.StringIO(text), "x"), BYTES_CODEC.unpack, time)
    link.open()
    received = []
    while len(received) < 3:
        received += [(time.monotonic_ns, unit) for unit in link.poll(0.2)]
        link.send(b"goes nowhere")
    with pytest.raises(EndOfRecordingError, match=r"the recording has ended$"):
        link.poll(0.2)
    assert received == [(77_000_000_000, b"one"), (77_250_000_000, b"two"), (79_500_000_000, b"\x00\xff")]


@given(st.integers(0, 400))
def test_given_a_recording_cut_anywhere_then_all_before_is_read(length: int) -> None:
    text, _ = make_recording()
    cut = text[: min(length, len(text))]
    try:
        records = list(RawReader(io.StringIO(cut), "x"))
    except RecordingError:
        assert "\n" not in cut
        return
    assert len(records) == max(0, cut.count("\n") - 1)


def test_given_damaged_lines_then_they_are_counted_and_the_others_read() -> None:
    text, _ = make_recording()
    lines = text.splitlines(keepends=True)
    lines[3:3] = ["< 1 2 zz\n", "nonsense\n", "? 1 2 00\n", "< x 2 00\n", "\n"]
    reader = RawReader(io.StringIO("".join(lines)), "x")
    assert len(list(reader)) == 6
    assert reader.damaged == 5


def test_given_a_limit_then_the_recording_is_no_larger_and_whole() -> None:
    text, writer = make_recording(limit=150)
    assert len(text) <= 150
    assert writer.is_full
    assert text.endswith("\n")
    assert len(list(RawReader(io.StringIO(text), "x"))) >= 1


def played_out(lines: list[str]) -> Exception:
    """Return how the playing of a recording with these lines ends."""
    text = "".join(["# modelserver raw 1 can wheels wheels\n", *lines])
    link = ReplayLink(RawReader(io.StringIO(text), "w.raw"), CAN_CODEC.unpack, FakeTimeSource())
    try:
        while True:
            link.poll(10.0)
    except (EndOfRecordingError, RecordingError) as error:
        return error


def test_given_damage_in_a_recording_when_played_then_its_end_reports_how_much() -> None:
    ended = played_out(["< 1 2 0000010000ff\n", "< 1 3 00\n", "nonsense\n"])
    assert isinstance(ended, EndOfRecordingError)
    assert ended.reason == "the recording has ended; 2 damaged lines of it were left out"


@pytest.mark.parametrize(
    ("lines", "why"),
    [(["nonsense\n", "< 1 3 00\n"], "all that was received is damaged, 2 lines"), ([], "nothing was received in it")],
)
def test_given_a_recording_of_which_nothing_can_be_played_then_it_is_an_error(lines: list[str], why: str) -> None:
    ended = played_out(lines)
    assert isinstance(ended, RecordingError)
    assert str(ended) == f"w.raw: nothing of it can be played: {why}"


class FullDisk(io.StringIO):
    """Takes so many writes."""

    def __init__(self, writes: int):
        super().__init__()
        self.left = writes

    def write(self, text: str) -> int:
        self.left -= 1
        if self.left < 0:
            raise OSError(28, "No space left on device")
        return super().write(text)


def test_given_a_full_disk_then_the_recording_ends_it_is_reported_once_and_the_line_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    writer = RawWriter(FullDisk(2), 1 << 20, "gps.raw")
    writer.begin("bytes", "gps", "novatel")
    time = FakeTimeSource()
    link = RecordingLink(FakeLink(time, [(1.5, b"one"), (1.6, b"two")]), BYTES_CODEC, writer, time)
    link.open()
    assert [*link.poll(1.0), *link.poll(1.0)] == [b"one", b"two"]
    link.send(b"log")
    writer.close()
    assert writer.is_full
    assert [(record.levelname, record.message) for record in caplog.records] == [
        ("WARNING", "recording gps.raw ended: No space left on device; the driver continues"),
        ("WARNING", "recording gps.raw: 3 records after its end were dropped"),
    ]


def test_given_a_limit_that_is_reached_then_it_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    make_recording(limit=150)
    assert [record.message for record in caplog.records][:1] == [
        "recording x ended: it has its 0.00015 MB, see --record-limit; the driver continues"
    ]


def keep(path: Path, *units: bytes) -> None:
    with open_for_writing(path, 1 << 20) as writer:
        writer.begin("bytes", "gps", "novatel")
        for unit in units:
            writer.record(RecordDirection.RECEIVED, HostTime(1, 2), unit)


def test_given_a_recording_of_that_name_then_it_stays_and_the_next_has_a_number(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "gps.raw"
    with caplog.at_level(logging.INFO):
        for unit in (b"one", b"two", b"three"):
            keep(path, unit)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["gps.1.raw", "gps.2.raw", "gps.raw"]
    reader = open_for_reading(tmp_path / "gps.1.raw")
    with reader.stream:
        assert [record.data for record in reader] == [b"two"]
    assert f"recording to {tmp_path / 'gps.2.raw'}: {path} is there already" in caplog.text


def test_given_another_file_of_that_name_then_it_stays_and_nothing_is_recorded(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text("vehicle: cart\n")
    with pytest.raises(RecordingError, match=r"vehicle.yaml is there, is no recording of a driver, and stays"):
        keep(path, b"one")
    assert path.read_text() == "vehicle: cart\n"


def test_given_what_a_full_disk_left_then_the_next_recording_has_a_number(tmp_path: Path) -> None:
    for head in ("", "# modelser"):
        path = tmp_path / f"{len(head)}.raw"
        path.write_text(head)
        keep(path, b"one")
        assert path.with_suffix(".1.raw").exists()


def test_given_nothing_to_record_then_no_file_is_left(tmp_path: Path) -> None:
    keep(tmp_path / "gps.raw")
    assert not list(tmp_path.iterdir())


def test_given_a_line_that_cannot_be_opened_then_nothing_is_recorded() -> None:
    stream, time = io.StringIO(), FakeTimeSource()
    link = FakeLink[bytes](time)
    link.outages = [(0.0, 1e9)]
    recorded_link = RecordingLink(link, BYTES_CODEC, RawWriter(stream, 1 << 20), time)
    for _ in range(3):
        with pytest.raises(LinkError):
            recorded_link.open()
        recorded_link.close()
    assert stream.getvalue() == ""


def test_given_a_device_as_the_file_then_it_is_written_and_a_full_one_ends_the_recording_alone(
    caplog: pytest.LogCaptureFixture,
) -> None:
    keep(Path("/dev/full"), b"one")
    assert "recording /dev/full ended: No space left on device" in caplog.text


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
    assert CAN_CODEC.unpack(CAN_CODEC.pack(frame)) == frame


@pytest.mark.parametrize(
    "unit",
    [
        ReadRegisters(5, 3, RegisterTable.INPUT, 77),
        Registers(5, (1, 65535), 77),
        ModbusFailure(FailureKind.EXCEPTION, "no such register", 2, 77),
    ],
)
def test_given_a_modbus_unit_then_its_form_keeps_all_of_it(unit: ReadRegisters | Registers | ModbusFailure) -> None:
    assert MODBUS_CODEC.unpack(MODBUS_CODEC.pack(unit)) == unit


@given(st.binary(max_size=40))
def test_given_any_bytes_then_a_form_rejects_or_takes_them(data: bytes) -> None:
    for form in (CAN_CODEC, MODBUS_CODEC):
        try:
            form.unpack(data)
        except ValueError:
            continue
