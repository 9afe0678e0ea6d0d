"""Samples of sources beside GPS, inertial unit and wheels between Python and wire, both ways.

Their numbers are looked at here, unlike those of the others: a pose that is no pose is damage, not a bad measurement.
"""

from __future__ import annotations

from collections.abc import Sequence

from modelserver.errors import WireError
from modelserver.messages import AbsolutePoseSample, RangeSample, RelativePoseSample
from modelserver.wire import fields
from mslcm.absolute_pose_t import absolute_pose_t
from mslcm.range_t import range_t
from mslcm.relative_pose_t import relative_pose_t


def read_absolute_pose(message: absolute_pose_t) -> AbsolutePoseSample:
    """Return the sample of a message. Raises WireError."""
    position = fields.vector3(message.position)
    orientation = fields.quaternion(message.orientation)
    return AbsolutePoseSample(
        fields.sensor_header(message.header),
        fields.frame_name(message.frame_of_interest, "frame_of_interest"),
        fields.frame_name(message.frame_of_reference, "frame_of_reference"),
        None if position is None else fields.finite_vector3(position, "position"),
        None if orientation is None else fields.unit_quaternion(orientation, "orientation"),
        _covariance(message.covariance),
    )


def write_absolute_pose(sample: AbsolutePoseSample) -> absolute_pose_t:
    """Return the message of a sample."""
    message = absolute_pose_t()
    message.header = fields.wire_sensor_header(sample.header)
    message.frame_of_interest = sample.frame_of_interest
    message.frame_of_reference = sample.frame_of_reference
    message.position = sample.position or fields.NAN3
    message.orientation = sample.orientation or fields.NAN4
    message.covariance = sample.covariance or fields.NAN36
    return message


def read_relative_pose(message: relative_pose_t) -> RelativePoseSample:
    """Return the sample of a message. Raises WireError."""
    header = fields.sensor_header(message.header)
    since = message.since_utime
    if not 0 < since < header.utime:
        raise WireError("malformed", f"since_utime {since} is no time before the sample's own, {header.utime}")
    return RelativePoseSample(
        header,
        fields.frame_name(message.frame, "frame"),
        since,
        fields.finite_vector3(message.position, "position"),
        fields.unit_quaternion(message.orientation, "orientation"),
        _covariance(message.covariance),
    )


def write_relative_pose(sample: RelativePoseSample) -> relative_pose_t:
    """Return the message of a sample."""
    message = relative_pose_t()
    message.header = fields.wire_sensor_header(sample.header)
    message.since_utime = sample.since_utime
    message.frame = sample.frame
    message.position = sample.position
    message.orientation = sample.orientation
    message.covariance = sample.covariance or fields.NAN36
    return message


def read_range(message: range_t) -> RangeSample:
    """Return the sample of a message. Raises WireError."""
    distance = message.distance
    if not 0.0 <= distance < fields.FAR:
        raise WireError("malformed", f"{distance} is no distance")
    return RangeSample(
        fields.sensor_header(message.header),
        fields.frame_name(message.frame, "frame"),
        fields.name(message.beacon, "beacon"),
        fields.finite_vector3(message.beacon_position, "beacon_position"),
        fields.frame_name(message.frame_of_reference, "frame_of_reference"),
        distance,
        message.sigma,
    )


def write_range(sample: RangeSample) -> range_t:
    """Return the message of a sample."""
    message = range_t()
    message.header = fields.wire_sensor_header(sample.header)
    message.frame = sample.frame
    message.beacon = sample.beacon
    message.beacon_position = sample.beacon_position
    message.frame_of_reference = sample.frame_of_reference
    message.distance = sample.distance
    message.sigma = sample.sigma
    return message


def _covariance(values: Sequence[float]) -> tuple[float, ...] | None:
    """Return the numbers of a covariance, None where the first is nan. Raises WireError where another is none."""
    if values[0] != values[0]:
        return None
    return fields.finite(values, "covariance")
