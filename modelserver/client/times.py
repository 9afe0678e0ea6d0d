"""Instants as programs have them: microseconds, datetime, numpy.datetime64."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Final, TypeAlias

import numpy as np

from modelserver.errors import MalformedRequestError

Time: TypeAlias = int | datetime | np.datetime64
"""An instant: microseconds since the Unix epoch, a datetime with a time zone, or a numpy.datetime64 (UTC)."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def to_utime(time: Time) -> int:
    """Return an instant in microseconds since the Unix epoch.

    Raises MalformedRequestError for a datetime without a time zone, and for anything else, such as seconds.
    """
    if isinstance(time, int | np.integer) and not isinstance(time, bool):
        return int(time)
    if isinstance(time, datetime):
        if time.tzinfo is None:
            raise MalformedRequestError(f"{time!r} has no time zone; write datetime.now(UTC), or .astimezone()")
        return (time - _EPOCH) // timedelta(microseconds=1)
    if isinstance(time, np.datetime64) and not np.isnat(time):
        return int(time.astype("datetime64[us]").astype(np.int64))
    hint = "; write int(1e6 * seconds)" if isinstance(time, float) else ""
    raise MalformedRequestError(
        f"a time is integer microseconds since 1970, a datetime or a numpy.datetime64, got {time!r}{hint}"
    )
