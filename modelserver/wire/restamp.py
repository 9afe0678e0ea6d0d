"""Sensor samples with their stamps moved: an old log as if its sensors spoke now."""

from __future__ import annotations

import struct
from typing import Final

from modelserver.errors import WireError
from modelserver.wire.kinds import is_stamped
from modelserver.wire.packed import read_text
from mslcm.relative_pose_t import relative_pose_t

_STAMPS = struct.Struct(">qdq")
"""Behind the fingerprint every sample begins with its header: utime, utime_sigma, host_utime."""

_SINCE = struct.Struct(">q")
_SOURCE_AT: Final = 48
"""Where the header's last member, the source, begins."""

_RELATIVE: Final[bytes] = relative_pose_t._get_packed_fingerprint()


def restamped(data: bytes, shift: int) -> bytes:
    """Return a sample, or a wish to the localization, with its stamps later by `shift` microseconds.

    Those are utime and host_utime, and the earlier instant of a relative pose. Other messages come back unchanged.
    """
    if not is_stamped(data) or len(data) < 8 + _STAMPS.size:
        return data
    utime, sigma, host_utime = _STAMPS.unpack_from(data, 8)
    moved = bytearray(data)
    try:
        _STAMPS.pack_into(moved, 8, utime + shift, sigma, host_utime + shift if host_utime else 0)
        if data[:8] == _RELATIVE:
            # the first field behind the header
            _, at = read_text(data, _SOURCE_AT)
            (since,) = _SINCE.unpack_from(data, at)
            _SINCE.pack_into(moved, at, since + shift)
    except (WireError, struct.error):
        return data  # damaged: who hears it counts it
    return bytes(moved)
