"""A CAN bus by python-can, for drivers and for emulators: every interface that it knows."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can

from modelserver.errors import nearest_names, shown
from msdrivers.links import LinkError
from msdrivers.protocol.can.frame import CanFrame

BURST = 64
"""Frames taken at a time at most."""

CLASSIC_BYTES = 8

MULTICAST = "udp_multicast"
"""The interface that carries frames over UDP, for trials without hardware: its channel is GROUP:PORT."""


class CanLink:
    """A bus on which every frame of others is heard, the interface's own error frames among them."""

    def __init__(self, channel: str, interface: str = "socketcan", bitrate: int = 0):
        """Name the bus. bitrate 0: the interface is set up already."""
        self.description = f"can {channel} ({interface})"
        self.baud = bitrate
        self._channel, self._interface = channel, interface
        self._bus: can.BusABC | None = None

    def open(self, baud: int | None = None) -> None:
        """Take part in the bus, if that is not done yet. Raises LinkError."""
        if self._bus is not None:
            return
        self.baud = baud or self.baud
        options: dict[str, Any] = {"channel": self._channel, "interface": self._interface}
        if self._interface == MULTICAST:
            group, _, port = self._channel.partition(":")
            # nothing leaves the machine
            options |= {"channel": group, "hop_limit": 0} | ({"port": int(port)} if port.isdecimal() else {})
        elif self.baud:
            options["bitrate"] = self.baud
        try:
            self._bus = can.Bus(**options)
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise self._explained(error) from None

    def close(self) -> None:
        """Take part no more."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(can.CanError, OSError):
                bus.shutdown()

    def poll(self, timeout: float) -> Sequence[CanFrame]:
        """Return the frames that came. Raises LinkError where the interface is gone or down."""
        bus = self._opened()
        frames: list[CanFrame] = []
        wait = max(0.0, timeout)
        try:
            while len(frames) < BURST and (message := bus.recv(wait)) is not None:
                wait = 0.0
                if not message.is_remote_frame:
                    frames.append(_frame(message))
        except (can.CanError, OSError) as error:
            raise self._explained(error) from None
        return frames

    def send(self, unit: CanFrame) -> None:
        """Send a frame. Raises LinkError."""
        message = can.Message(
            arbitration_id=unit.arbitration_id,
            data=unit.data,
            is_extended_id=unit.is_extended,
            is_error_frame=unit.is_error,
            is_fd=len(unit.data) > CLASSIC_BYTES,
        )
        try:
            self._opened().send(message, timeout=0.1)
        except (can.CanError, OSError, ValueError) as error:
            raise self._explained(error) from None

    def _opened(self) -> can.BusABC:
        if self._bus is None:
            raise LinkError(self.description, "the bus is not open")
        return self._bus

    def _explained(self, error: Exception) -> LinkError:
        number = getattr(error, "error_code", None) or getattr(error, "errno", None)
        channel = self._channel
        if self._interface not in can.VALID_INTERFACES:
            near = nearest_names(self._interface, can.VALID_INTERFACES)
            return LinkError(
                f"unknown CAN interface {shown(self._interface)}",
                "python-can has none of that name",
                f"write {near[0]}" if near else f"known: {', '.join(sorted(can.VALID_INTERFACES))}",
            )
        if number == errno.ENODEV:
            known = ", ".join(can_networks()) or "none"
            return LinkError(self.description, "there is no such network interface", f"those of CAN here: {known}")
        if number == errno.ENETDOWN:
            fix = f"sudo ip link set {channel} up type can bitrate 500000 (or the bus's own rate)"
            return LinkError(self.description, "the interface is down", fix)
        if number == errno.ENOBUFS:
            fix = "is another node on the bus, and is it terminated?"
            return LinkError(self.description, "frames are not taken: nobody acknowledges them", fix)
        if number in (errno.EACCES, errno.EPERM):
            return LinkError(self.description, "permission denied", "see who may use it")
        why = os.strerror(number) if number else str(error) or type(error).__name__
        return LinkError(self.description, why, "see the interface's page in python-can's documentation")


def _frame(message: can.Message) -> CanFrame:
    return CanFrame(message.arbitration_id, bytes(message.data), message.is_extended_id, message.is_error_frame)


CAN_TYPE = "280"
"""ARPHRD_CAN in linux/if_arp.h."""


def can_networks() -> list[str]:
    """Return the names of this machine's CAN network interfaces."""
    found = []
    for kind in sorted(Path("/sys/class/net").glob("*/type")):
        with contextlib.suppress(OSError):
            if kind.read_text().strip() == CAN_TYPE:
                found.append(kind.parent.name)
    return found
