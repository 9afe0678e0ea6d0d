"""Emulator of an inertial unit that sends lines of text, as the settings of its driver describe them."""

from __future__ import annotations

from collections.abc import Iterable

from modelserver.messages import ImuSample
from msdrivers.emulate.sample_emulator import SampleEmulator
from msdrivers.endpoint import Output, Send
from msdrivers.protocol.text_lines import LineDescription, encode_line

CELSIUS = 25.0


class TextImuEmulator(SampleEmulator[ImuSample]):
    """An `Endpoint` of bytes that sends a line for each sample. `samples` are in the order of their stamps."""

    def __init__(self, samples: Iterable[ImuSample], settings: LineDescription) -> None:
        super().__init__(samples)
        self._settings = settings
        self._first_utime: int | None = None

    def _send_sample(self, sample: ImuSample) -> list[Output[bytes]]:
        self.counts["lines"] += 1
        return [Send(self._encode(sample))]

    def _encode(self, sample: ImuSample) -> bytes:
        self._first_utime = sample.header.utime if self._first_utime is None else self._first_utime
        values = {name: self._get_value(sample, name) for name in self._settings.fields}
        return encode_line(self._settings, values)

    def _get_value(self, sample: ImuSample, name: str) -> float:
        assert self._first_utime is not None
        if name == "time":
            return 1.0 + (sample.header.utime - self._first_utime) * 1e-6
        if name == "temperature":
            return CELSIUS
        vector = getattr(sample, name[:-2])
        return 0.0 if vector is None else float(vector["xyz".index(name[-1])])
