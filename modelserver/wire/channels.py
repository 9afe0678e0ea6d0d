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
DRIVE_SIGNED: Final = "VEHICLE_COMMAND_SIGNED"
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


def _channels(use: ChannelUse, *rows: tuple[str, str, str, str]) -> tuple[Channel, ...]:
    return tuple(Channel(name, type_name, use, rate, about) for name, type_name, rate, about in rows)


def _request(name: str, question: str, reply: str) -> tuple[str, str, str, str]:
    return (name, f"{question}_request_t", "on demand", f"answered by {reply}")


REQUESTS = _channels(
    ChannelUse.REQUEST,
    _request("PLATFORM_GET_TRANSFORMATION", "get_transformation", "get_transformation_reply_t"),
    _request("PLATFORM_GET_BODY_LIST", "get_body_list", "name_list_reply_t"),
    _request("PLATFORM_GET_BODY_FRAME_LIST", "get_body_frame_list", "name_list_reply_t"),
    _request("POSE_GET_STATE_VECTOR", "get_state_vector", "get_state_vector_reply_t"),
    _request("POSE_GET_H_TRANSFORM", "get_h_transform", "get_transformation_reply_t"),
    _request("POSE_GET_HISTORY", "get_history", "get_history_reply_t"),
    _request("PLATFORM_GET_TRANSFORMATIONS", "get_transformations", "get_transformations_reply_t, in parts"),
    _request("PLATFORM_GET_MOTION", "get_motion", "get_motion_reply_t"),
    _request("PLATFORM_GET_EXPLANATION", "get_explanation", "get_explanation_reply_t"),
    _request("PLATFORM_GET_DYNAMICS", "get_dynamics", "get_dynamics_reply_t"),
    _request("PLATFORM_RELOAD_MODEL", "reload_model", "reload_model_reply_t; where allowed"),
    _request("PLATFORM_SET_FRAME", "set_frame", "reload_model_reply_t; where allowed"),
    _request("POSE_SET_STATE_VECTOR", "set_state_vector", "acknowledgement_t; where allowed"),
    _request("POSE_SET_H_TRANSFORM", "set_h_transform", "acknowledgement_t; where allowed"),
)

CHANNELS = (
    *_channels(
        ChannelUse.SENSOR,
        ("GPS", "gps_t", "1-20 Hz", "fixes of the satellite receiver"),
        ("IMU", "imu_t", "30-200 Hz", "rates, specific force, field, own orientation"),
        ("WHEELS", "wheels_t", "10-100 Hz", "travel, speed and direction of each wheel"),
        ("JOINTS", "joints_t", "50 Hz and more", "positions and rates of joints"),
        ("ABSOLUTE_POSE", "absolute_pose_t", "as they come", "poses in the world by other means than GPS"),
        ("RELATIVE_POSE", "relative_pose_t", "as they come", "motion between two instants, e.g. by visual odometry"),
        ("RANGE", "range_t", "as they come", "distances to beacons at known positions"),
        ("MEASUREMENT", "measurement_t", "as they come", "measurements of installed packages"),
        ("VEHICLE_STATUS", "vehicle_status_t", "1-20 Hz", "status of the vehicle controller"),
    ),
    *_channels(
        ChannelUse.COMMAND,
        ("VEHICLE_COMMAND", "vehicle_command_t", "10 Hz and more", "commands to the vehicle controller"),
        ("LOCALIZATION_MODE", "localization_mode_t", "on demand", "which sources localization uses"),
        (SIGNED, "signed_t", "on demand", "signed commands"),
        (DRIVE_SIGNED, "signed_t", "10 Hz and more", "signed commands to the vehicle controller"),
    ),
    *_channels(
        ChannelUse.BROADCAST,
        ("POSE", "pose_transform_t", "timer or event", "base frame in World:UTM"),
        ("POSE_VECTOR", "pose_vector_t", "with POSE", "the same as a 7-vector"),
        ("POSE_ODOM", "pose_transform_t", "with POSE", "base frame in Odom:Origin, never jumps"),
        (
            "LOCALIZATION_DECISIONS",
            "decisions_t",
            "on sensor events",
            "innovation tests: which measurements were used, and why",
        ),
        ("LOCALIZATION_STATE", "navigation_state_t", "timer, 5 Hz", "the filter's state"),
        ("MODEL_SNAPSHOT", "model_snapshot_t", "at start, on change, every 5 s", "the geometry"),
        ("JOINTS_HELD", "joints_t", "with MODEL_SNAPSHOT", "the newest reading of each joint"),
        ("MODELSERVER_HEALTH", "health_t", "1 Hz, on change", "state, traffic, rejected input"),
    ),
    *_channels(
        ChannelUse.REPORT,
        ("DRIVER_HEALTH", "driver_health_t", "1 Hz, on change", "health of each driver: phase, rate, clock"),
    ),
    *REQUESTS,
)

BY_NAME = {channel.name: channel for channel in CHANNELS}


def to_subscription_pattern(channel: str) -> str:
    """Return the regular expression that matches only `channel`: LCM interprets subscriptions as patterns.

    LCM adds ^ and $; $ also matches before a trailing line break, \\z does not.
    """
    return re.escape(channel) + r"\z"
