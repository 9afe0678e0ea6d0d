"""What is heard on the channel of a sensor: decoded, and stamped with the instant of measurement."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import Final

from modelserver.core.writers import Mark
from modelserver.messages import RelativePoseSample, Sample, SwitchMode
from modelserver.wire.codec import decode
from modelserver.wire.fields import MAX_NAME, MAX_UTIME

_HEAD: Final = struct.Struct(">8sq24xqi")
"""Of every sensor message: fingerprint, header.utime, header.seq and the length of header.source, which follows.

Between the two numbers lie utime_sigma, host_utime and device_utime (sensor_header_t.lcm).
"""

_NEW: Final = tuple.__new__
"""A NamedTuple made by its own name costs three times as much."""


@dataclass(frozen=True, slots=True)
class SensorChannel:
    """A channel that is listened to: its wire type, and by how many microseconds its stamps come late."""

    type_name: str
    latency_us: int = 0

    @property
    def has_publisher(self) -> bool:
        """Return whether the channel is a sensor's, which has one publisher; anyone may ask for a mode."""
        return self.type_name != "localization_mode_t"

    def read(self, data: bytes) -> Sample | SwitchMode:
        """Return the sample or the wish in `data`. Raises WireError."""
        value: Sample | SwitchMode = decode(self.type_name, data)
        return earlier(value, self.latency_us) if self.latency_us else value


def peek(data: bytes, fingerprint: bytes) -> Mark | None:
    """Return whose sample a message is, at a tenth of what `SensorChannel.read` costs; None where only that can say.

    `fingerprint` is that of the type which the channel carries. The message may still be damaged behind its header.
    """
    if len(data) <= _HEAD.size:
        return None
    found, utime, seq, length = _HEAD.unpack_from(data)
    end = _HEAD.size + length
    if found != fingerprint or not 0 < utime < MAX_UTIME or not 0 < length <= MAX_NAME + 1 or end > len(data):
        return None
    return _NEW(Mark, (utime, data[_HEAD.size : end - 1].decode("utf-8", "replace"), seq))


def earlier(sample: Sample | SwitchMode, microseconds: int) -> Sample | SwitchMode:
    """Return a sample with the instants that it tells of so much earlier; when it was received stays."""
    header = replace(sample.header, utime=max(1, sample.header.utime - microseconds))
    if isinstance(sample, RelativePoseSample):
        return replace(sample, header=header, since_utime=max(1, sample.since_utime - microseconds))
    return replace(sample, header=header)
