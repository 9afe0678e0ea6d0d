"""Answers to queries: poses with their validity, one and in batches."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from modelserver.earth import Origin
from modelserver.messages.flags import MET, NAN, NO_FLAGS, Quality, Unmet
from modelserver.transforms.so3 import Array
from modelserver.transforms.transformation import Transformation

if TYPE_CHECKING:
    from modelserver.earth.geodesy import GeodeticPose


class PoseAnswer(NamedTuple):
    """A transformation with the other fields of pose_transform_t.

    `origin` is None where no world frame is involved or the origin is not known. The levels, in m and rad, are those
    that an error exceeds with a probability of 1e-4 at an instant; `limit_risk` is that of an error beyond a configured
    limit, `horizontal_allowance` the part of the horizontal level that is an offset for suspected faults.
    `unmet` and `unmet_reason` are those of the reply to a query with a demand.
    """

    transformation: Transformation
    origin: Origin | None = None
    quality: Quality = NO_FLAGS
    horizontal_protection_level: float = NAN
    heading_protection_level: float = NAN
    seconds_to_limit: float = NAN
    horizontal_level: float = NAN
    heading_level: float = NAN
    limit_risk: float = NAN
    horizontal_allowance: float = NAN
    unmet: Unmet = MET
    unmet_reason: str = ""

    @property
    def geodetic(self) -> GeodeticPose | None:
        """Latitude, longitude, height and true heading of the frame of interest; None if not in a world frame."""
        # loads pyproj
        from modelserver.earth.geodesy import compute_geodetic

        if self.origin is None:
            return None
        found = self.transformation
        return compute_geodetic(found.pose, found.frame_of_reference, self.origin)


class PoseBatch(NamedTuple):
    """Poses of one pair of frames at n instants; see get_transformations_reply_t.

    `vectors` (n, 7) are state vectors, nan where `status` is not OK; `covariances` (n, 36), None = not requested or not
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

    def slice_instants(self, first: int, end: int) -> PoseBatch:
        return PoseBatch._make([each[first:end] if isinstance(each, np.ndarray) else each for each in self])
