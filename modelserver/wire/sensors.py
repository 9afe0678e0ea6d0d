"""Sensor samples between Python and wire, both ways."""

from __future__ import annotations

from modelserver.errors import WireError
from modelserver.messages import (
    Direction,
    FixType,
    GpsSample,
    ImuSample,
    JointSample,
    JointsSample,
    OrientationReference,
    WheelSample,
    WheelsSample,
    YawSource,
)
from modelserver.wire import fields
from mslcm.gps_t import gps_t
from mslcm.imu_t import imu_t
from mslcm.joints_t import joints_t
from mslcm.wheels_t import wheels_t

MAX_PARTS = 1024
"""Wheels or joints in one message; more is taken for a damaged message."""


def read_gps(message: gps_t) -> GpsSample:
    """Return the sample of a message. Raises WireError."""
    return GpsSample(
        fields.sensor_header(message.header),
        fields.member(FixType, message.fix_type, "fix_type"),
        message.latitude_deg,
        message.longitude_deg,
        message.height_ellipsoidal,
        message.height_msl,
        message.undulation,
        message.satellites,
        message.hdop,
        message.vdop,
        message.pdop,
        fields.matrix3(message.position_covariance),
        fields.vector3(message.velocity),
        fields.matrix3(message.velocity_covariance),
        message.velocity_latency,
        message.speed,
        message.speed_sigma,
        message.course,
        message.course_sigma,
        message.baseline_yaw,
        message.baseline_yaw_sigma,
    )


def write_gps(sample: GpsSample) -> gps_t:
    """Return the message of a sample."""
    message = gps_t()
    message.header = fields.wire_sensor_header(sample.header)
    message.fix_type = int(sample.fix_type)
    message.satellites = sample.satellites
    for name in (
        "latitude_deg",
        "longitude_deg",
        "height_ellipsoidal",
        "height_msl",
        "undulation",
        "hdop",
        "vdop",
        "pdop",
        "velocity_latency",
        "speed",
        "speed_sigma",
        "course",
        "course_sigma",
        "baseline_yaw",
        "baseline_yaw_sigma",
    ):
        setattr(message, name, getattr(sample, name))
    message.position_covariance = sample.position_covariance or fields.NAN9
    message.velocity = sample.velocity or fields.NAN3
    message.velocity_covariance = sample.velocity_covariance or fields.NAN9
    return message


def read_imu(message: imu_t) -> ImuSample:
    """Return the sample of a message. Raises WireError."""
    return ImuSample(
        fields.sensor_header(message.header),
        fields.vector3(message.angular_velocity),
        fields.vector3(message.specific_force),
        fields.vector3(message.magnetic_field),
        fields.quaternion(message.orientation),
        fields.member(OrientationReference, message.orientation_reference, "orientation_reference"),
        fields.member(YawSource, message.yaw_source, "yaw_source"),
        fields.matrix3(message.angular_velocity_covariance),
        fields.matrix3(message.specific_force_covariance),
        fields.matrix3(message.orientation_covariance),
        message.temperature_celsius,
    )


def write_imu(sample: ImuSample) -> imu_t:
    """Return the message of a sample."""
    message = imu_t()
    message.header = fields.wire_sensor_header(sample.header)
    message.angular_velocity = sample.angular_velocity or fields.NAN3
    message.angular_velocity_covariance = sample.angular_velocity_covariance or fields.NAN9
    message.specific_force = sample.specific_force or fields.NAN3
    message.specific_force_covariance = sample.specific_force_covariance or fields.NAN9
    message.magnetic_field = sample.magnetic_field or fields.NAN3
    message.orientation_reference = int(sample.orientation_reference)
    message.yaw_source = int(sample.yaw_source)
    message.orientation = sample.orientation or fields.NAN4
    message.orientation_covariance = sample.orientation_covariance or fields.NAN9
    message.temperature_celsius = sample.temperature_celsius
    return message


def read_wheels(message: wheels_t) -> WheelsSample:
    """Return the sample of a message. Raises WireError."""
    _check_count(message.num_wheels)
    return WheelsSample(
        fields.sensor_header(message.header),
        tuple(
            WheelSample(
                message.names[n],
                message.travel[n],
                message.travel_sigma[n],
                message.speed[n],
                message.speed_sigma[n],
                fields.member(Direction, message.direction[n], "direction"),
                message.steering[n],
            )
            for n in range(message.num_wheels)
        ),
    )


def write_wheels(sample: WheelsSample) -> wheels_t:
    """Return the message of a sample."""
    message = wheels_t()
    message.header = fields.wire_sensor_header(sample.header)
    message.num_wheels = len(sample.wheels)
    message.names = [wheel.name for wheel in sample.wheels]
    message.travel = [wheel.travel for wheel in sample.wheels]
    message.travel_sigma = [wheel.travel_sigma for wheel in sample.wheels]
    message.speed = [wheel.speed for wheel in sample.wheels]
    message.speed_sigma = [wheel.speed_sigma for wheel in sample.wheels]
    message.direction = [int(wheel.direction) for wheel in sample.wheels]
    message.steering = [wheel.steering for wheel in sample.wheels]
    return message


def read_joints(message: joints_t) -> JointsSample:
    """Return the sample of a message. Raises WireError."""
    _check_count(message.num_joints)
    return JointsSample(
        fields.sensor_header(message.header),
        tuple(
            JointSample(
                message.names[n],
                message.position[n],
                message.position_sigma[n],
                message.rate[n],
                message.rate_sigma[n],
            )
            for n in range(message.num_joints)
        ),
    )


def write_joints(sample: JointsSample) -> joints_t:
    """Return the message of a sample."""
    message = joints_t()
    message.header = fields.wire_sensor_header(sample.header)
    message.num_joints = len(sample.joints)
    message.names = [joint.name for joint in sample.joints]
    message.position = [joint.position for joint in sample.joints]
    message.position_sigma = [joint.position_sigma for joint in sample.joints]
    message.rate = [joint.rate for joint in sample.joints]
    message.rate_sigma = [joint.rate_sigma for joint in sample.joints]
    return message


def _check_count(count: int) -> None:
    if not 0 <= count <= MAX_PARTS:
        raise WireError("malformed", f"{count} entries in one message; 0 to {MAX_PARTS} are taken")
