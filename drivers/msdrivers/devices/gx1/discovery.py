"""Find a 3DM-GX1 on a line and read its identity and gains: scripts of the driver and the hard-iron procedure."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

from msdrivers.devices.gx1.script import CollectStep, Gx1Receiver, NoReplyError, PauseStep, RequestStep, Step
from msdrivers.endpoint import EndpointPhase, EndpointStatus, Reopen, Send
from msdrivers.protocol.gx1 import MEASUREMENTS, CommandByte, EepromAddress, Gains, Gx1Packet, requests
from msdrivers.protocol.gx1.scaling import format_version

T = TypeVar("T")
ScriptPart: TypeAlias = Generator[Step, tuple[Gx1Packet, ...], T]
"""A part of a script that finds a value."""

LISTEN_S = 0.3
FLUSH_TIMEOUT_S = 1.0
"""How long a device may take to end its stream, as DUNE's driver allows."""

KNOWN_FLUSH_TIMEOUT_S = 0.2
"""The same for a device that has answered here before: if that was too short it is tried again."""

KNOWN_ATTEMPTS = 3
"""Attempts at the baud rate at which a device was found before."""

RETRY_DELAY_S = 5.0
"""Delay between failed attempts."""

GAIN_RANGE = (1000, 30_000)
"""The least and the greatest gain that is believed: a vector's full scale is a thousandth of it in gauss, g or rad/s.
Those that are known of are 2000 to 10000."""

GYRO_GAIN_3DMG = 64
"""Of the 3DM-G, the older model with the same protocol and other scales."""


class UnusableDeviceError(Exception):
    """The device answers, but its data cannot be used."""


@dataclass(slots=True)
class LineState:
    """Baud rates to try, in this order, and what the device streamed when it was found.

    found_stream: None until known, 0 for none. is_known: a device has answered at the first baud rate.
    """

    bauds: list[int]
    """Empty for a line that has none."""
    found_stream: int | None = None
    is_known: bool = False

    @property
    def at_baud_text(self) -> str:
        """Text for the present baud rate; empty without one."""
        return f" at {self.bauds[0]} baud" if self.bauds else ""

    def make_restore_request(self) -> bytes:
        """Return the request that leaves the continuous mode as it was found."""
        return requests.make_stream(self.found_stream) if self.found_stream else requests.STOP


def find_device(link: Gx1Receiver, found: LineState) -> ScriptPart[str]:
    """Find the device: stop what it streams at one baud rate after the other. Return its serial number and firmware.

    Returns once one answers. The line is taken to be open at the first of the baud rates.
    """
    while True:
        received: list[str] = []
        for number in range(max(1, len(found.bauds))):
            if number:
                found.bauds.append(found.bauds.pop(0))
                yield Reopen(f"no 3DM-GX1 at {found.bauds[-1]} baud, received {received[-1]}", found.bauds[0])
            # a known device returns at its rate: try others only after several attempts
            for attempt in range(KNOWN_ATTEMPTS if found.is_known else 1):
                link.reset()
                try:
                    yield from _stop_stream(
                        link, found, KNOWN_FLUSH_TIMEOUT_S if found.is_known and not attempt else FLUSH_TIMEOUT_S
                    )
                    device = yield from _read_identity()
                except NoReplyError:
                    continue
                found.is_known = True
                return device
            found.is_known = False
            received.append(link.describe_input())
        yield EndpointStatus(EndpointPhase.SILENT, _explain_no_device(found.bauds, received))
        yield PauseStep(RETRY_DELAY_S)
        if len(found.bauds) > 1:
            found.bauds.append(found.bauds.pop(0))
            yield Reopen("no 3DM-GX1 found, trying again", found.bauds[0])


def _stop_stream(link: Gx1Receiver, found: LineState, flush: float) -> ScriptPart[None]:
    """Record what the device streams (two replies of one kind) and stop it, within `flush` seconds."""
    listened = yield CollectStep(LISTEN_S, frozenset(MEASUREMENTS))
    kinds = [packet.command for packet in listened]
    if found.found_stream is None:
        found.found_stream = next((kind for kind in kinds if kinds.count(kind) > 1), None)
    if link.bytes_received:
        # a stop command may be sent in the middle of a streamed reply: the second one is answered clearly
        yield Send(requests.STOP)
        yield PauseStep(flush)
    yield RequestStep(requests.STOP, value=0)
    if found.found_stream is None:
        found.found_stream = 0
    # what was listened to may have been noise that looked like replies
    link.ticks.reset()


def _read_identity() -> ScriptPart[str]:
    (serial,) = yield RequestStep(requests.make_poll(CommandByte.SERIAL))
    (firmware,) = yield RequestStep(requests.make_poll(CommandByte.FIRMWARE))
    return f"3DM-GX1 serial {serial.unsigned}, firmware {format_version(firmware.unsigned)}"


def _explain_no_device(bauds: Sequence[int], received: Sequence[str]) -> str:
    # after the attempts the list of rates is rotated by one
    order = [f"at {baud} baud " for baud in (*bauds[1:], *bauds[:1])] or [""]
    attempts = "; ".join(f"{at}received {what}" for at, what in zip(order, received, strict=True))
    if all(what == "nothing" for what in received):
        why = "check the device's power, the cable, and that the port is the right one"
    elif any("text" in what for what in received):
        why = "text is from another device: check which port the 3DM-GX1 is on"
    elif bauds:
        why = "another device, or a baud rate that was not tried: check the port, and the list of baud rates"
    else:
        why = "another device, or the baud rate of the device server is not the 3DM-GX1's: check both"
    return f"no 3DM-GX1 answers on this line: {attempts}; {why}; trying again in {RETRY_DELAY_S:g} s"


def read_word(address: int) -> ScriptPart[int]:
    """Read a word of the EEPROM, unsigned."""
    (reply,) = yield RequestStep(requests.make_read_eeprom(address))
    return reply.unsigned


def read_words(addresses: Iterable[int]) -> ScriptPart[tuple[int, ...]]:
    """Read words of the EEPROM, unsigned."""
    words: tuple[int, ...] = ()
    for address in addresses:
        words = (*words, (yield from read_word(address)))
    return words


def write_word(address: int, value: int) -> ScriptPart[None]:
    """Write a word of the EEPROM; the next one 10 ms later."""
    yield RequestStep(requests.make_write_eeprom(address, value))
    yield PauseStep(0.01)


def read_gains() -> ScriptPart[Gains]:
    """Read the gains. Raises UnusableError for those that no 3DM-GX1 can have.

    They are read twice: a reply does not contain its address, and a delayed one would pass for the next.
    """
    addresses = (EepromAddress.GYRO_GAIN, EepromAddress.ACCELEROMETER_GAIN, EepromAddress.MAGNETOMETER_GAIN)
    words = yield from read_words(addresses)
    again = yield from read_words(addresses)
    if words != again:
        raise UnusableDeviceError(
            f"the gains in its EEPROM were read twice, as {list(words)} and as {list(again)}: its replies come late or "
            "are damaged; check the cable, and the device server if there is one"
        )
    gyro, accelerometer, magnetometer = words
    if gyro == GYRO_GAIN_3DMG:
        raise UnusableDeviceError(
            f"the gyro gain in its EEPROM (address {EepromAddress.GYRO_GAIN}) is {gyro}, that of the older 3DM-G with "
            "other scales: connect a 3DM-GX1"
        )
    for name, address, gain in (
        ("gyro", EepromAddress.GYRO_GAIN, gyro),
        ("accelerometer", EepromAddress.ACCELEROMETER_GAIN, accelerometer),
        ("magnetometer", EepromAddress.MAGNETOMETER_GAIN, magnetometer),
    ):
        if not GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
            raise UnusableDeviceError(
                f"the {name} gain in its EEPROM (address {address}) is {gain}, and no 3DM-GX1 has one outside "
                f"{GAIN_RANGE[0]} to {GAIN_RANGE[1]}: the EEPROM is erased or damaged; write the gain "
                "from the device's calibration sheet to it"
            )
    return Gains(gyro, accelerometer, magnetometer)
