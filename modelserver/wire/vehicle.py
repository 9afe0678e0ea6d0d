"""The vehicle controller's status and commands between Python and wire, both ways.

The numbers of a command are looked at here: a wish that is no number must not reach what moves the vehicle.
"""

from __future__ import annotations

import math

from modelserver.errors import WireError
from modelserver.messages import VehicleCommand, VehicleMode, VehicleStatusSample
from modelserver.wire import fields
from mslcm.vehicle_command_t import vehicle_command_t
from mslcm.vehicle_status_t import vehicle_status_t

_STATUS = (
    "forward_speed",
    "steering_angle",
    "supply_voltage",
    "engine_speed",
    "fault_bits",
    "commands_refused",
)
_COMMAND = ("utime", "valid_for", "seq", "source", "forward_speed", "steering_angle")


def read_vehicle_status(message: vehicle_status_t) -> VehicleStatusSample:
    """Return the sample of a message. Raises WireError."""
    if message.commands_refused < 0:
        raise WireError("malformed", f"commands_refused {message.commands_refused} is negative")
    return VehicleStatusSample(
        header=fields.sensor_header(message.header),
        mode=fields.member(VehicleMode, message.mode, "mode"),
        **{name: getattr(message, name) for name in _STATUS},
    )


def write_vehicle_status(sample: VehicleStatusSample) -> vehicle_status_t:
    """Return the message of a sample."""
    message = vehicle_status_t()
    message.header = fields.wire_sensor_header(sample.header)
    message.mode = int(sample.mode)
    for name in _STATUS:
        setattr(message, name, getattr(sample, name))
    return message


def read_vehicle_command(message: vehicle_command_t) -> VehicleCommand:
    """Return the command of a message. Raises WireError for one without time, or whose numbers are none."""
    if message.utime <= 0:
        raise WireError("malformed", f"a command needs utime, got {message.utime}")
    if not (math.isfinite(message.valid_for) and message.valid_for > 0.0):
        raise WireError("malformed", f"valid_for {message.valid_for:g} is no positive number of seconds")
    fields.finite((message.forward_speed, message.steering_angle), "a command")
    return VehicleCommand(
        utime=fields.checked_utime(message.utime),
        valid_for=message.valid_for,
        seq=message.seq,
        source=fields.name(message.source, "source"),
        forward_speed=message.forward_speed,
        steering_angle=message.steering_angle,
    )


def write_vehicle_command(command: VehicleCommand) -> vehicle_command_t:
    """Return the message of a command."""
    message = vehicle_command_t()
    for name in _COMMAND:
        setattr(message, name, getattr(command, name))
    return message
