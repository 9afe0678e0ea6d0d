"""CAN bus link by python-can, for drivers and emulators, with any of its interfaces."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can

from msdrivers.endpoint import CanFrame
from msdrivers.links import LinkError
from msdrivers.registry import MULTICAST, find_channel_problem, find_interface_problem, split_group

MAX_FRAMES_PER_POLL = 64
"""Frames taken at a time at most."""

CLASSIC_CAN_BYTES = 8

HOST_STAMPED = ("socketcan", MULTICAST, "virtual")
"""Interfaces that stamp frames by the host's clock when they come, the first two in the kernel. Others stamp by a clock
of their own, or when a frame is read."""

STAMP_TOLERANCE_US = 1000
"""By how much a stamp may be before the instant at which nothing was left to read."""

MAX_ECHOES = 256
"""Frames of our own that may be under way."""

# its messages are part of our own errors, and it would log them at each attempt
logging.getLogger("can").setLevel(logging.CRITICAL)


class CanLink:
    """A CAN bus; receives the frames of other nodes and the interface's error frames.

    Frames carry their receive time where the interface stamps them by the host's clock.
    """

    def __init__(self, channel: str, interface: str = "socketcan", bitrate: int = 0):
        self.description = f"can {channel} ({interface})"
        self.baud = bitrate
        self._channel, self._interface = channel, interface
        self._bus: can.BusABC | None = None
        self._emptied_us = 0
        self._echoes: deque[CanFrame] = deque(maxlen=MAX_ECHOES)

    def open(self, baud: int | None = None) -> None:
        """Open the bus unless it is open. Raises LinkError."""
        if self._bus is not None:
            return
        self.baud = baud or self.baud
        for word, why in (
            ("interface", find_interface_problem(self._interface)),
            ("channel", find_channel_problem(self._channel, self._interface)),
        ):
            if why:
                raise LinkError(self.description, f"{word} {why}")
        options: dict[str, Any] = {"channel": self._channel, "interface": self._interface}
        if self._interface == MULTICAST:
            group, port = split_group(self._channel)
            # nothing leaves the machine
            options |= {"channel": group, "port": port, "hop_limit": 0}
        elif self.baud:
            options["bitrate"] = self.baud
        self._echoes.clear()
        self._emptied_us = _get_utc_us()
        try:
            self._bus = can.Bus(**options)
        # whatever the library of a maker raises: a name that is not defined without it, a missing argument
        except Exception as error:
            raise self._explain_error(error) from None

    def close(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(Exception):
                bus.shutdown()

    def poll(self, timeout: float) -> Sequence[CanFrame]:
        """Return received frames. Raises LinkError if the interface is lost or down."""
        bus = self._require_bus()
        frames: list[CanFrame] = []
        wait = max(0.0, timeout)
        try:
            while len(frames) < MAX_FRAMES_PER_POLL:
                asked_us = _get_utc_us()
                message = bus.recv(wait)
                if message is None:
                    # frames read later were received later than this
                    self._emptied_us = asked_us
                    break
                wait = 0.0
                frame = self._convert_frame(message)
                if not message.is_remote_frame and not self._is_own_echo(message, frame):
                    frames.append(frame)
        except Exception as error:
            raise self._explain_error(error) from None
        return frames

    def send(self, unit: CanFrame) -> None:
        message = can.Message(
            arbitration_id=unit.arbitration_id,
            data=unit.data,
            is_extended_id=unit.is_extended,
            is_error_frame=unit.is_error,
            is_fd=len(unit.data) > CLASSIC_CAN_BYTES,
        )
        bus = self._require_bus()
        try:
            bus.send(message, timeout=0.1)
        except Exception as error:
            raise self._explain_error(error) from None
        if self._interface == MULTICAST:
            self._echoes.append(unit)

    def _convert_frame(self, message: can.Message) -> CanFrame:
        stamp = round(message.timestamp * 1e6) if self._interface in HOST_STAMPED else 0
        # a clock that was set since makes a stamp of the past or of the future
        is_sound = self._emptied_us - STAMP_TOLERANCE_US <= stamp <= _get_utc_us()
        return CanFrame(
            message.arbitration_id,
            bytes(message.data),
            message.is_extended_id,
            message.is_error_frame,
            stamp if is_sound else 0,
        )

    def _is_own_echo(self, message: can.Message, frame: CanFrame) -> bool:
        """Return whether a frame is an echo of our own: some adapters flag it, multicast returns it in order."""
        if not message.is_rx:
            # Linux flags frames of other programs on this machine as well, and does not return ours
            return self._interface != "socketcan"
        if frame not in self._echoes:
            return False
        while self._echoes.popleft() != frame:
            pass
        return True

    def _require_bus(self) -> can.BusABC:
        if self._bus is None:
            raise LinkError(self.description, "the bus is not open")
        return self._bus

    def _explain_error(self, error: Exception) -> LinkError:
        found = getattr(error, "error_code", None) or getattr(error, "errno", None)
        # getaddrinfo has numbers of its own, below 0
        number = found if isinstance(found, int) and found > 0 else 0
        channel = self._channel
        if number in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
            return LinkError(self.description, "this kernel knows no CAN", "sudo modprobe -a can can_raw")
        if number == errno.ENODEV:
            known = ", ".join(list_can_interfaces()) or "none"
            return LinkError(self.description, "there is no such network interface", f"those of CAN here: {known}")
        if number == errno.ENETDOWN:
            fix = f"sudo ip link set {channel} up type can bitrate 500000 (or the bus's own rate)"
            return LinkError(self.description, "the interface is down", fix)
        if number == errno.ENOBUFS:
            fix = "is another node on the bus, and is it terminated?"
            return LinkError(self.description, "frames are not acknowledged by any node", fix)
        if number in (errno.EACCES, errno.EPERM):
            return LinkError(self.description, "permission denied", "see who may use it")
        if isinstance(error, NameError | ImportError):
            fix = "install the driver and the library of the adapter's maker"
            return LinkError(self.description, f"its library is not there ({error})", fix)
        why = os.strerror(number) if number else str(error) or type(error).__name__
        return LinkError(self.description, why, "see the interface's page in python-can's documentation")


def _get_utc_us() -> int:
    return time.time_ns() // 1000


ARPHRD_CAN = "280"
"""ARPHRD_CAN in linux/if_arp.h."""


def list_can_interfaces() -> list[str]:
    """Return the names of this machine's CAN network interfaces."""
    found = []
    for kind in sorted(Path("/sys/class/net").glob("*/type")):
        with contextlib.suppress(OSError):
            if kind.read_text().strip() == ARPHRD_CAN:
                found.append(kind.parent.name)
    return found
