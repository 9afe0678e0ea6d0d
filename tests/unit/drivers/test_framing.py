"""The scanner of a stream, whatever its formats do."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from msdrivers.devices.stream import FrameScanner, ParsedFrame, RejectedFrame


class Failing:
    """A format with an error of its own: frames of two bytes, the second of which is divided by."""

    start_bytes = b"#"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[int] | RejectedFrame | None:
        if len(buffer) < at + 2:
            return None
        return ParsedFrame(at + 2, "frame", 100 // (buffer[at + 1] - 48))


def test_given_a_format_that_fails_on_a_frame_then_that_is_rejected_and_the_next_is_taken() -> None:
    scanner = FrameScanner((Failing(),))
    assert scanner.feed(b"#1#0#2") == [100, 50]
    assert scanner.counts == {"frame": 2, "rejected.error": 1, "skipped": 2}
    assert scanner.pending_bytes == 0


@given(st.lists(st.binary(max_size=50)))
def test_given_any_bytes_and_a_format_that_fails_then_nothing_is_raised_or_buffered(parts: list[bytes]) -> None:
    scanner = FrameScanner((Failing(),))
    for part in parts:
        scanner.feed(part)
        assert scanner.pending_bytes <= 1
