"""gpsd: its reports, one JSON object a line (gpsd_json(5))."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from modelserver.messages import NAN, FixType
from msdrivers.protocol.framing import NO_FRAME, FrameScanner, ParsedFrame, RejectedFrame

MAX_LINE: Final = 16_384
"""A longer line is noise: a SKY report has 200 bytes for each satellite."""

WATCH: Final = b'?WATCH={"enable":true,"json":true}\n'

USED: Final = frozenset({"TPV", "SKY", "GST", "VERSION", "DEVICES", "WATCH", "ERROR"})

_STATUS: Final = {2: FixType.DIFFERENTIAL, 3: FixType.RTK_FIXED, 4: FixType.RTK_FLOAT}
_DEAD_RECKONING: Final = (5, 6)
_NO_MEASUREMENT: Final = (7, 8)
"""A surveyed position of a time receiver, and a simulation."""


@dataclass(frozen=True, slots=True)
class GpsdReport:
    """A report: its class, its fields, and the offset of its first byte in the stream."""

    name: str
    fields: Mapping[str, Any]
    start: int

    def get_number(self, key: str) -> float:
        """Return a finite number; nan if it is missing or something else."""
        value = self.fields.get(key)
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        return float(value) if is_number and value is not None else NAN

    @property
    def utime(self) -> int:
        """The instant of the report, microseconds of UTC; 0 if it has none."""
        text = self.fields.get("time")
        if not isinstance(text, str):
            return 0
        try:
            when = datetime.fromisoformat(text)
        except ValueError:
            return 0
        if when.tzinfo is None:
            return 0
        return max(0, (when - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1))

    @property
    def fix_type(self) -> FixType:
        """The type of the fix of a TPV report."""
        mode, status = self.fields.get("mode"), self.fields.get("status")
        if mode not in (2, 3) or status in _NO_MEASUREMENT:
            return FixType.NONE
        if status in _DEAD_RECKONING:
            return FixType.DEAD_RECKONING
        plain = FixType.FIX_3D if mode == 3 else FixType.FIX_2D
        return _STATUS.get(status, plain) if isinstance(status, int) else plain


class GpsdFormat:
    """A `FrameFormat` of gpsd's lines."""

    start_bytes = b"{"

    def scan(self, buffer: bytearray, at: int, start: int) -> ParsedFrame[GpsdReport] | RejectedFrame | None:
        """Parse the line at `at`."""
        end = buffer.find(b"\n", at, at + MAX_LINE)
        if end < 0:
            return None if len(buffer) - at < MAX_LINE else RejectedFrame("length")
        try:
            fields = json.loads(bytes(buffer[at:end]))
        except (ValueError, RecursionError):
            return RejectedFrame("json")
        name = fields.get("class") if isinstance(fields, dict) else None
        if not isinstance(name, str):
            return NO_FRAME
        report = GpsdReport(name, fields, start) if name in USED else None
        return ParsedFrame(end + 1, f"gpsd.{name[:16]}", report)


class GpsdStream(FrameScanner[GpsdReport]):
    """Parses bytes to reports. Never raises; memory is bounded."""

    def __init__(self) -> None:
        super().__init__((GpsdFormat(),))
