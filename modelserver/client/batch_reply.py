"""Batch replies (GetTransformations) assembled from their parts."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.client.times import Time, to_utime
from modelserver.errors import MalformedRequestError, WireError
from modelserver.messages import PoseBatch, PoseBatchReply
from modelserver.wire.fields import MAX_PAIRS


class BatchQuery(NamedTuple):
    """A query of `PlatformClient.get_transformations`, with checked pairs and times."""

    pairs: tuple[tuple[str, str], ...]
    utimes: npt.NDArray[np.int64]
    fixed_frame: str
    reference_at: int
    covariance: bool


def check_batch(
    pairs: Sequence[tuple[str, str]], at: Sequence[Time] | npt.NDArray[Any]
) -> tuple[tuple[tuple[str, str], ...], npt.NDArray[np.int64]]:
    """Return the pairs and times of a batch query. Raises MalformedRequestError where the wire cannot hold them."""
    wanted = tuple((interest, reference) for interest, reference in pairs)
    try:
        given = np.asarray(at)
        if given.dtype.kind == "M" or (given.dtype.kind == "O" and given.ndim == 1):
            given = np.array([to_utime(each) for each in at], dtype=np.int64)
        utimes = given.astype(np.int64)
        is_integer = given.ndim == 1 and bool((utimes == given).all())
    except (TypeError, ValueError, OverflowError):
        is_integer = False
    if not is_integer:
        raise MalformedRequestError(
            f"times must be integer microseconds since 1970, datetime or datetime64, got {reprlib.repr(at)}"
        )
    if not 1 <= len(wanted) <= MAX_PAIRS:
        raise MalformedRequestError(f"a batch query has 1 to {MAX_PAIRS} pairs, got {len(wanted)}")
    return wanted, utimes


class BatchReplyAssembler:
    """Collect the parts of one batch reply, received in any order and possibly more than once.

    A retried request is answered again from newer data: parts of two replies are not mixed.
    """

    def __init__(self, decode: Callable[[bytes], PoseBatchReply]):
        self._decode = decode
        self._answers: dict[tuple[int, int], dict[int, PoseBatchReply]] = {}
        self._parts: dict[int, PoseBatchReply] = {}

    def add(self, data: bytes) -> bool:
        """Add a part; return whether the reply is complete. Raises the QueryError in the reply, WireError."""
        part = self._decode(data)
        self._parts = self._answers.setdefault((part.header.utime, part.parts), {})
        self._parts[part.part] = part
        return len(self._parts) >= part.parts

    def join(self, pairs: tuple[tuple[str, str], ...], utimes: npt.NDArray[np.int64]) -> list[PoseBatch]:
        """Return the poses of each pair. Raises WireError where they are not those of `utimes`."""
        of_pair: dict[int, list[PoseBatchReply]] = {}
        for part in self._parts.values():
            of_pair.setdefault(part.pair, []).append(part)
        joined = []
        for number, (interest, reference) in enumerate(pairs):
            parts = sorted(of_pair.get(number, []), key=lambda part: part.first)
            held = 0
            for part in parts:
                if part.first != held:
                    raise WireError(
                        "malformed", f"a part starts at instant {part.first}, but the previous one ends at {held}"
                    )
                held += 0 if part.poses is None else len(part.poses.vectors)
            poses = concatenate([part.poses for part in parts if part.poses is not None])
            if len(poses.vectors) != len(utimes):
                raise WireError("malformed", f"{len(poses.vectors)} poses received for {len(utimes)} instants")
            joined.append(poses._replace(frame_of_interest=interest, frame_of_reference=reference, utimes=utimes))
        return joined


def concatenate(parts: list[PoseBatch]) -> PoseBatch:
    """Concatenate batches of one pair's poses in time. Raises WireError for none."""
    if not parts:
        raise WireError("malformed", "the reply has status OK and no poses")
    first, *more = parts
    if not more:
        return first
    # an array that one part does not have is none of the whole: the covariances
    columns = [[each for each in column if isinstance(each, np.ndarray)] for column in zip(*parts, strict=True)]
    return PoseBatch._make(
        np.concatenate(column) if len(column) == len(parts) else None if column else value
        for column, value in zip(columns, first, strict=True)
    )
