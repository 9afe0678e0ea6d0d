"""What is answered."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from modelserver.errors import Status
from modelserver.messages.estimates import Origin
from modelserver.messages.flags import NAN, NO_FLAGS, Quality
from modelserver.spatial.pose import Pose
from modelserver.spatial.so3 import Array, Vector3
from modelserver.spatial.transformation import Transformation


class PoseAnswer(NamedTuple):
    """A transformation with all that the wire says beside it; see pose_transform_t.

    `origin` is None where no world frame is involved or the origin is not known.
    """

    transformation: Transformation
    origin: Origin | None = None
    quality: Quality = NO_FLAGS
    horizontal_bound: float = NAN
    heading_bound: float = NAN
    seconds_to_limit: float = NAN


class MotionAnswer(NamedTuple):
    """How a frame moves in another, beside where it is: along the axes of `expressed_in`, seen from the reference.

    Velocity (m/s) of the frame's origin, angular `rate` (rad/s), and their changes (m/s2, rad/s2); nan where nobody
    knows. `covariance` is 36 numbers, row-major, of velocity and rate; None: not known.
    """

    pose: PoseAnswer
    expressed_in: str
    velocity: Vector3
    rate: Vector3
    acceleration: Vector3
    turn_acceleration: Vector3
    covariance: tuple[float, ...] | None = None


class EdgeReport(NamedTuple):
    """One edge of the way that an answer rests on, from the frame of reference on; see path_edge_t.

    `kind` is frame, constraint, joint or vehicle; `ends` the names at its two ends, passed from the first to the second
    where `forward`; `pose` that of the far end in the near one, as passed. `how` is fixed, measured, interpolated,
    held, predicted or at_rest; `stamp` the utime of the newest measurement in it, 0 for none, `age` its age in seconds.
    `position_share` and `rotation_share` are its parts of the variance, 0 to 1; nan: it states none. `doubt` says in
    words what speaks against it, empty: nothing.
    """

    kind: str
    name: str
    forward: bool
    ends: tuple[str, str]
    pose: Pose
    how: str
    stamp: int = 0
    age: float = NAN
    source: str = ""
    coordinates: tuple[float, ...] = ()
    position_share: float = NAN
    rotation_share: float = NAN
    doubt: str = ""


class Explanation(NamedTuple):
    """An answer, and each edge that it rests on."""

    answer: PoseAnswer
    edges: tuple[EdgeReport, ...]


class ManyPoses(NamedTuple):
    """Where a frame is in another at many instants, arrays of n; see get_transformations_reply_t.

    `vectors` (n, 7) are state vectors, nan where `status` is not OK; `covariances` (n, 36), None: not asked or not
    known. `origin` is that of World:UTM, None where no such frame is involved.
    """

    frame_of_interest: str
    frame_of_reference: str
    utimes: npt.NDArray[np.int64]
    vectors: Array
    status: npt.NDArray[np.int32]
    invalid: npt.NDArray[np.int32]
    quality: npt.NDArray[np.int32]
    epochs: npt.NDArray[np.int32]
    covariances: Array | None = None
    origin: Origin | None = None
    model_revision: str = ""

    def part(self, first: int, end: int) -> ManyPoses:
        """Return those of the instants from number `first` to before `end`."""
        some = slice(first, end)
        return self._replace(
            utimes=self.utimes[some],
            vectors=self.vectors[some],
            status=self.status[some],
            invalid=self.invalid[some],
            quality=self.quality[some],
            epochs=self.epochs[some],
            covariances=None if self.covariances is None else self.covariances[some],
        )


class ReplyHeader(NamedTuple):
    """How a request ended."""

    request_id: int
    utime: int
    status: Status = Status.OK
    message: str = ""
    nearest: tuple[str, ...] = ()
    model_revision: str = ""


class TransformReply(NamedTuple):
    """Answers GetTransformation and GetHTransform; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: PoseAnswer | None = None


class NameListReply(NamedTuple):
    """Answers GetBodyList and GetBodyFrameList."""

    header: ReplyHeader
    names: tuple[str, ...] = ()
    descriptions: tuple[str, ...] = ()


class StateVectorReply(NamedTuple):
    """Answers GetStateVector; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: PoseAnswer | None = None


class HistoryReply(NamedTuple):
    """Answers GetHistory."""

    header: ReplyHeader
    answers: tuple[PoseAnswer, ...] = ()


class ManyReply(NamedTuple):
    """A part of the answer to GetTransformations; `poses` is None unless the status is OK.

    It is of pair number `pair`, from instant number `first` on.
    """

    header: ReplyHeader
    part: int = 0
    parts: int = 1
    pair: int = 0
    first: int = 0
    poses: ManyPoses | None = None


class MotionReply(NamedTuple):
    """Answers GetMotion; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: MotionAnswer | None = None


class ExplanationReply(NamedTuple):
    """Answers GetExplanation; `answer` is None unless the status is OK."""

    header: ReplyHeader
    answer: Explanation | None = None


class ReloadReply(NamedTuple):
    """Answers ReloadModel: the revision of the geometry in the file, and what it changes, in words."""

    header: ReplyHeader
    revision: str = ""
    changes: tuple[str, ...] = ()


class Acknowledgement(NamedTuple):
    """Answers a request for something to be done."""

    header: ReplyHeader


Reply: TypeAlias = (
    TransformReply
    | NameListReply
    | StateVectorReply
    | HistoryReply
    | ManyReply
    | MotionReply
    | ExplanationReply
    | ReloadReply
    | Acknowledgement
)
