"""What is heard on the channel of a sensor: decoded, and stamped with the instant of measurement."""

from __future__ import annotations

from dataclasses import dataclass, replace

from modelserver.messages import RelativePoseSample, Sample, SwitchMode
from modelserver.wire.codec import decode


@dataclass(frozen=True, slots=True)
class Heard:
    """A channel that is listened to: its wire type, and by how many microseconds its stamps come late."""

    type_name: str
    latency_us: int = 0

    def read(self, data: bytes) -> Sample | SwitchMode:
        """Return the sample or the wish in `data`. Raises WireError."""
        value: Sample | SwitchMode = decode(self.type_name, data)
        return earlier(value, self.latency_us) if self.latency_us else value


def earlier(sample: Sample | SwitchMode, microseconds: int) -> Sample | SwitchMode:
    """Return a sample with the instants that it tells of so much earlier; when it was received stays."""
    header = replace(sample.header, utime=max(1, sample.header.utime - microseconds))
    if isinstance(sample, RelativePoseSample):
        return replace(sample, header=header, since_utime=max(1, sample.since_utime - microseconds))
    return replace(sample, header=header)
