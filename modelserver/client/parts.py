"""Replies that come in parts, put together again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from modelserver.errors import WireError
from modelserver.messages import ManyPoses, ManyReply


class Parts:
    """The parts of one reply, in whatever order they come, and however often.

    A question that is asked again is answered again, of what is known then: parts of two answers are not mixed.
    """

    def __init__(self, opened: Callable[[bytes], ManyReply]):
        self._opened = opened
        self._answers: dict[tuple[int, int], dict[int, ManyReply]] = {}
        self._parts: dict[int, ManyReply] = {}

    def add(self, data: bytes) -> bool:
        """Take a part; return whether nothing is missing. Raises the QueryError that the server meant, WireError."""
        part = self._opened(data)
        self._parts = self._answers.setdefault((part.header.utime, part.parts), {})
        self._parts[part.part] = part
        return len(self._parts) >= part.parts

    def joined(self, pairs: tuple[tuple[str, str], ...], utimes: npt.NDArray[np.int64]) -> list[ManyPoses]:
        """Return the poses of each pair. Raises WireError where the parts do not hold what was asked for."""
        of_pair: dict[int, list[ManyReply]] = {}
        for part in self._parts.values():
            of_pair.setdefault(part.pair, []).append(part)
        joined = []
        for number, (interest, reference) in enumerate(pairs):
            parts = sorted(of_pair.get(number, []), key=lambda part: part.first)
            held = 0
            for part in parts:
                if part.first != held:
                    raise WireError(
                        "malformed", f"a part begins at instant {part.first}, the one before ends at {held}"
                    )
                held += 0 if part.poses is None else len(part.poses.vectors)
            poses = stacked([part.poses for part in parts if part.poses is not None])
            if len(poses.vectors) != len(utimes):
                raise WireError("malformed", f"{len(poses.vectors)} poses came for {len(utimes)} instants")
            joined.append(poses._replace(frame_of_interest=interest, frame_of_reference=reference, utimes=utimes))
        return joined


def stacked(parts: list[ManyPoses]) -> ManyPoses:
    """Return several stretches of one pair's poses as one. Raises WireError for none."""
    if not parts:
        raise WireError("malformed", "the server said OK but sent no poses")
    first, *more = parts
    if not more:
        return first
    covariances = [part.covariances for part in parts if part.covariances is not None]
    return first._replace(
        utimes=np.concatenate([part.utimes for part in parts]),
        vectors=np.concatenate([part.vectors for part in parts]),
        status=np.concatenate([part.status for part in parts]),
        invalid=np.concatenate([part.invalid for part in parts]),
        quality=np.concatenate([part.quality for part in parts]),
        epochs=np.concatenate([part.epochs for part in parts]),
        covariances=np.concatenate(covariances) if len(covariances) == len(parts) else None,
    )
