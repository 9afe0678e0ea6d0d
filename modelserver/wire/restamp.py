"""Sensor samples with their stamps moved: an old log as if its sensors spoke now."""

from __future__ import annotations

import struct

from modelserver.wire.kinds import is_sample

_STAMPS = struct.Struct(">qdq")
"""Behind the fingerprint every sample begins with its header: utime, utime_sigma, host_utime."""


def restamped(data: bytes, shift: int) -> bytes:
    """Return a sample with utime and host_utime later by `shift` microseconds; other messages come back unchanged."""
    if not is_sample(data) or len(data) < 8 + _STAMPS.size:
        return data
    utime, sigma, host_utime = _STAMPS.unpack_from(data, 8)
    moved = _STAMPS.pack(utime + shift, sigma, host_utime + shift if host_utime else 0)
    return data[:8] + moved + data[8 + _STAMPS.size :]
