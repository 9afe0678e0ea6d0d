"""VehicleCommander: commands to the vehicle controller, signed where there is a key."""

from __future__ import annotations

import math
import os
import time
from types import TracebackType
from typing import Self

import lcm

from modelserver.client.publisher import check_source
from modelserver.client.remote import load_signer
from modelserver.messages import VehicleCommand
from modelserver.wire.channels import DRIVE_SIGNED
from modelserver.wire.codec import encode
from modelserver.wire.provider import open_lcm, resolve_url

CHANNEL = "VEHICLE_COMMAND"


class VehicleCommander:
    """Command the vehicle controller, through its driver.

        with modelserver.VehicleCommander("planner", key_file="commands.key") as commander:
            commander.drive(1.0, 0.1)   # again at least ten times a second

    The vehicle stops when the last command expires. Where the vehicle file has a key file, commands must be signed.

    Parameters
    ----------
    source
        Name of the commanding program: only one may command at a time.
    url, channel_prefix
        LCM provider, default $LCM_DEFAULT_URL, else loopback; prefix of the vehicle's channels.
    key_file
        The vehicle's key, default $MODELSERVER_KEY_FILE; without either, commands are not signed. Raises KeyFileError.
    """

    def __init__(self, source: str, *, url: str = "", channel_prefix: str = "", key_file: str | os.PathLike[str] = ""):
        check_source(source, "program")
        self._source, self._prefix, self._seq = source, channel_prefix, 0
        self._signer = load_signer(os.fspath(key_file), channel_prefix, source)
        self._bus: lcm.LCM | None = open_lcm(resolve_url(url))

    def drive(self, forward_speed: float, steering_angle: float = 0.0, *, valid_for: float = 0.3) -> VehicleCommand:
        """Command a speed (m/s, forward positive) and a steering angle (rad, to the left) for some seconds.

        Raises ValueError for what cannot be.
        """
        if not math.isfinite(forward_speed) or not abs(steering_angle) <= math.pi / 2 or not 0.0 < valid_for < 10.0:
            raise ValueError(
                "a command has a finite speed, a steering angle of at most pi/2 rad, and is valid for 0 to 10 s, got "
                f"{forward_speed}, {steering_angle}, {valid_for}"
            )
        utime = time.time_ns() // 1000
        command = VehicleCommand(utime, valid_for, self._seq, self._source, float(forward_speed), float(steering_angle))
        self._seq += 1
        if self._bus is None:
            raise ValueError("this VehicleCommander is closed")
        if self._signer is None:
            self._bus.publish(f"{self._prefix}{CHANNEL}", encode(command))
        else:
            self._bus.publish(f"{self._prefix}{DRIVE_SIGNED}", self._signer.seal(CHANNEL, encode(command)))
        return command

    def close(self) -> None:
        """Leave the bus. The vehicle stops when the last command expires."""
        self._bus = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
