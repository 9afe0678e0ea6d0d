"""Recordings of a line: what was recorded comes again at its time, also from a damaged file."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.errors import RecordingError
from msdrivers.links import EndOfRecordingError, LinkError
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.raw_log import (
    EVENT,
    RECEIVED,
    SENT,
    RawRecord,
    RecordingLink,
    ReplayLink,
    open_for_reading,
    read_records,
)
from msdrivers.raw_log import open_for_writing as create

HEAD = "# modelserver raw 1 bytes gps novatel\n"


class OpenText(io.StringIO):
    """Text that can be read after it was closed; takes so many writes."""

    def __init__(self, writes: int = 1000):
        super().__init__()
        self.left, self.text = writes, ""

    def write(self, text: str) -> int:
        self.left -= 1
        if self.left < 0:
            raise OSError(28, "No space left on device")
        self.text += text
        return len(text)


def make_recording() -> str:
    time = FakeTimeSource()
    start = time.monotonic_ns * 1e-9
    units = [(start + 0.5, b"one"), (start + 0.75, b"two"), (start + 3.0, b"\x00\xff")]
    stream = OpenText()
    link = RecordingLink(FakeLink(time, units), stream, "gps", "novatel", time)
    link.open(38400)
    link.send(b"log")
    while time.monotonic_ns * 1e-9 < start + 4.0:
        link.poll(0.2)
    link.close()
    return stream.text


def read(text: str) -> list[RawRecord | None]:
    stream = io.StringIO(text)
    stream.readline()
    return list(read_records(stream))


def replay(text: str, time: FakeTimeSource) -> ReplayLink:
    stream = io.StringIO(text)
    stream.readline()
    return ReplayLink(stream, "w.raw", time)


def test_given_a_line_when_recorded_then_all_of_it_stands_there_with_times() -> None:
    text = make_recording()
    assert text.startswith(HEAD)
    records = [record for record in read(text) if record is not None]
    assert [(record.direction, record.data) for record in records] == [
        (EVENT, b"open fake 38400"),
        (SENT, b"log"),
        (RECEIVED, b"one"),
        (RECEIVED, b"two"),
        (RECEIVED, b"\x00\xff"),
    ]
    received = [record.time for record in records if record.direction == RECEIVED]
    assert received[1].utime - received[0].utime == 250_000
    assert received[1].monotonic_ns - received[0].monotonic_ns == 250_000_000


def test_given_a_recording_when_played_then_units_come_as_long_after_each_other_and_then_it_ends() -> None:
    time = FakeTimeSource(monotonic_ns=77_000_000_000)
    link = replay(make_recording(), time)
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
    text = make_recording()
    cut = text[: min(length, len(text))]
    assert len([record for record in read(cut) if record]) == max(0, cut.count("\n") - 1)


def test_given_damaged_lines_then_they_are_counted_and_the_others_read() -> None:
    lines = make_recording().splitlines(keepends=True)
    lines[3:3] = ["< 1 2 zz\n", "nonsense\n", "? 1 2 00\n", "< x 2 00\n", "\n"]
    records = read("".join(lines))
    assert len(records) == 10
    assert records.count(None) == 5


def played_out(lines: list[str]) -> Exception:
    """Return how the playing of a recording with these lines ends."""
    link = replay("".join([HEAD, *lines]), FakeTimeSource())
    try:
        while True:
            link.poll(10.0)
    except (EndOfRecordingError, RecordingError) as error:
        return error


def test_given_damage_in_a_recording_when_played_then_its_end_reports_how_much() -> None:
    ended = played_out(["< 1 2 0000010000ff\n", "< 1 3 0\n", "nonsense\n"])
    assert isinstance(ended, EndOfRecordingError)
    assert ended.reason == "the recording has ended; 2 damaged lines of it were left out"


@pytest.mark.parametrize(
    ("lines", "why"),
    [(["nonsense\n", "< 1 3 0\n"], "all that was received is damaged, 2 lines"), ([], "nothing was received in it")],
)
def test_given_a_recording_of_which_nothing_can_be_played_then_it_is_an_error(lines: list[str], why: str) -> None:
    ended = played_out(lines)
    assert isinstance(ended, RecordingError)
    assert str(ended) == f"w.raw: nothing of it can be played: {why}"


def test_given_a_full_disk_then_the_recording_ends_it_is_reported_once_and_the_line_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    time = FakeTimeSource()
    units = [(1.5, b"one"), (1.6, b"two")]
    link = RecordingLink(FakeLink(time, units), OpenText(2), "gps", "novatel", time)
    link.open()
    assert [*link.poll(1.0), *link.poll(1.0)] == [b"one", b"two"]
    link.send(b"log")
    assert [(record.levelname, record.message) for record in caplog.records] == [
        ("WARNING", "the recording has ended: No space left on device; the driver continues")
    ]


def test_given_a_limit_that_is_reached_then_it_is_reported(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("msdrivers.raw_log.MAX_SIZE", 150)
    assert len(make_recording()) <= 150
    assert [record.message for record in caplog.records] == [
        "the recording has ended: it has 0.00015 MB; the driver continues"
    ]


def test_given_a_file_of_that_name_then_it_stays_and_nothing_is_recorded(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text("vehicle: cart\n")
    with pytest.raises(RecordingError, match=r"vehicle.yaml is there already, and stays; name another"):
        create(path)
    assert path.read_text() == "vehicle: cart\n"


def test_given_a_line_that_cannot_be_opened_then_nothing_is_recorded() -> None:
    stream, time = OpenText(), FakeTimeSource()
    link = FakeLink[bytes](time)
    link.outages = [(0.0, 1e9)]
    recorded_link = RecordingLink(link, stream, "gps", "novatel", time)
    for _ in range(3):
        with pytest.raises(LinkError):
            recorded_link.open()
        recorded_link.close()
    assert stream.text == HEAD


@pytest.mark.parametrize("text", ["", "hello\n", "# modelserver raw 2 bytes a b\n", "# modelserver raw 1 bytes\n"])
def test_given_another_file_then_it_is_no_recording(text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.raw"
    path.write_text(text)
    with pytest.raises(RecordingError, match="no recording of a driver"):
        open_for_reading(path, "gps", "novatel")
