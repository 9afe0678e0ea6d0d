"""The channels of the service: one table for daemon, clients, drivers and documentation."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

DEFAULT_URL = "udpm://239.255.76.67:7667?ttl=0"
"""Loopback only: nothing leaves the machine unless a vehicle file or $LCM_DEFAULT_URL asks for it."""

REPLY_PREFIX = "REPLY_"

SIGNED: Final = "MODELSERVER_SIGNED"
"""The channel of signed commands, without the vehicle's prefix."""

PROBE_CHANNEL = "MODELSERVER_PROBE"
"""Channel of the bus self-test: random bytes that a program sends to itself."""


class ChannelUse(StrEnum):
    """Purpose of a channel, which determines its publisher."""

    SENSOR = "sensor"
    REQUEST = "request"
    BROADCAST = "broadcast"
    COMMAND = "command"
    REPORT = "report"


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel: name without prefix, message type, purpose, rate, description."""

    name: str
    type_name: str
    use: ChannelUse
    rate: str
    about: str


CHANNELS = (
    Channel("GPS", "gps_t", ChannelUse.SENSOR, "1-20 Hz", "fixes of the satellite receiver"),
    Channel("IMU", "imu_t", ChannelUse.SENSOR, "30-200 Hz", "rates, specific force, field, own orientation"),
    Channel("WHEELS", "wheels_t", ChannelUse.SENSOR, "10-100 Hz", "travel, speed and direction of each wheel"),
    Channel("JOINTS", "joints_t", ChannelUse.SENSOR, "50 Hz and more", "positions and rates of joints"),
    Channel(
        "ABSOLUTE_POSE",
        "absolute_pose_t",
        ChannelUse.SENSOR,
        "as they come",
        "poses in the world by other means than GPS",
    ),
    Channel(
        "RELATIVE_POSE",
        "relative_pose_t",
        ChannelUse.SENSOR,
        "as they come",
        "motion between two instants, e.g. by visual odometry",
    ),
    Channel("RANGE", "range_t", ChannelUse.SENSOR, "as they come", "distances to beacons at known positions"),
    Channel("VEHICLE_STATUS", "vehicle_status_t", ChannelUse.SENSOR, "1-20 Hz", "status of the vehicle controller"),
    Channel(
        "VEHICLE_COMMAND",
        "vehicle_command_t",
        ChannelUse.COMMAND,
        "10 Hz and more",
        "commands to the vehicle controller",
    ),
    Channel(
        "LOCALIZATION_MODE", "localization_mode_t", ChannelUse.COMMAND, "on demand", "which sources localization uses"
    ),
    Channel("MODELSERVER_SIGNED", "signed_t", ChannelUse.COMMAND, "on demand", "signed commands"),
    Channel("POSE", "pose_transform_t", ChannelUse.BROADCAST, "timer or event", "base frame in World:UTM"),
    Channel("POSE_VECTOR", "pose_vector_t", ChannelUse.BROADCAST, "with POSE", "the same as a 7-vector"),
    Channel(
        "POSE_ODOM", "pose_transform_t", ChannelUse.BROADCAST, "with POSE", "base frame in Odom:Origin, never jumps"
    ),
    Channel(
        "LOCALIZATION_DECISIONS",
        "decisions_t",
        ChannelUse.BROADCAST,
        "on sensor events",
        "innovation tests: which measurements were used, and why",
    ),
    Channel("LOCALIZATION_STATE", "navigation_state_t", ChannelUse.BROADCAST, "timer, 5 Hz", "the filter's state"),
    Channel(
        "MODEL_SNAPSHOT", "model_snapshot_t", ChannelUse.BROADCAST, "at start, on change, every 5 s", "the geometry"
    ),
    Channel("JOINTS_HELD", "joints_t", ChannelUse.BROADCAST, "with MODEL_SNAPSHOT", "the newest reading of each joint"),
    Channel(
        "MODELSERVER_HEALTH", "health_t", ChannelUse.BROADCAST, "1 Hz, on change", "state, traffic, rejected input"
    ),
    Channel(
        "DRIVER_HEALTH",
        "driver_health_t",
        ChannelUse.REPORT,
        "1 Hz, on change",
        "health of each driver: phase, rate, clock",
    ),
    Channel(
        "PLATFORM_GET_TRANSFORMATION",
        "get_transformation_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by get_transformation_reply_t",
    ),
    Channel(
        "PLATFORM_GET_BODY_LIST",
        "get_body_list_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by name_list_reply_t",
    ),
    Channel(
        "PLATFORM_GET_BODY_FRAME_LIST",
        "get_body_frame_list_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by name_list_reply_t",
    ),
    Channel(
        "POSE_GET_STATE_VECTOR",
        "get_state_vector_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by get_state_vector_reply_t",
    ),
    Channel(
        "POSE_GET_H_TRANSFORM",
        "get_h_transform_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by get_transformation_reply_t",
    ),
    Channel(
        "POSE_GET_HISTORY", "get_history_request_t", ChannelUse.REQUEST, "on demand", "answered by get_history_reply_t"
    ),
    Channel(
        "PLATFORM_GET_TRANSFORMATIONS",
        "get_transformations_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by get_transformations_reply_t, in parts",
    ),
    Channel(
        "PLATFORM_GET_MOTION", "get_motion_request_t", ChannelUse.REQUEST, "on demand", "answered by get_motion_reply_t"
    ),
    Channel(
        "PLATFORM_GET_EXPLANATION",
        "get_explanation_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by get_explanation_reply_t",
    ),
    Channel(
        "PLATFORM_RELOAD_MODEL",
        "reload_model_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by reload_model_reply_t; where allowed",
    ),
    Channel(
        "POSE_SET_STATE_VECTOR",
        "set_state_vector_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by acknowledgement_t; where allowed",
    ),
    Channel(
        "POSE_SET_H_TRANSFORM",
        "set_h_transform_request_t",
        ChannelUse.REQUEST,
        "on demand",
        "answered by acknowledgement_t; where allowed",
    ),
)

BY_NAME = {channel.name: channel for channel in CHANNELS}
REQUESTS = tuple(channel for channel in CHANNELS if channel.use is ChannelUse.REQUEST)


def to_subscription_pattern(channel: str) -> str:
    """Return the regular expression that matches only `channel`: LCM interprets subscriptions as patterns.

    LCM adds ^ and $; $ also matches before a trailing line break, \\z does not.
    """
    return re.escape(channel) + r"\z"
