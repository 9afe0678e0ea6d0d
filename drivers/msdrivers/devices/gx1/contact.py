"""Finding a 3DM-GX1 on a line and reading what it is: scripts that the driver and the hard-iron procedure share."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

from msdrivers.devices.gx1.dialogue import Ask, Listen, NoReplyError, Pause, Step
from msdrivers.devices.gx1.link import Gx1Link
from msdrivers.protocol.gx1 import DATA, Address, CommandByte, Gains, Packet, requests
from msdrivers.protocol.gx1.scaling import version_text
from msdrivers.station import Reopen, Send, StationPhase, StationStatus

T = TypeVar("T")
Part: TypeAlias = Generator[Step, tuple[Packet, ...], T]
"""A part of a script that finds a value."""

LISTEN_S = 0.3
FLUSH_S = 1.0
"""How long a device may take to end what it streams, as DUNE's driver allows."""

KNOWN_FLUSH_S = 0.2
"""The same for a device that has answered here before: if that was too short it is tried again."""

PATIENCE = 3
"""Attempts at the baud rate at which a device was found before."""

RETRY_S = 5.0
"""From one vain attempt to the next."""

GAINS = (1000, 30_000)
"""The least and the greatest gain that is believed: a vector's full scale is a thousandth of it in gauss, g or rad/s.
Those that are known of are 2000 to 10000."""

OLD_GYRO_GAIN = 64
"""Of the 3DM-G, the model before: it speaks the same protocol with other scales."""


class UnusableError(Exception):
    """The device answers, and what it says cannot be used."""


@dataclass(slots=True)
class ContactState:
    """What is known of the line: the baud rates in the order to try, what the device streamed when it was found.

    `streamed` is None until that is known, and 0 for a device that streamed nothing. `known`: a device has answered at
    the first of the baud rates.
    """

    bauds: list[int]
    """Empty for a line that has none."""
    streamed: int | None = None
    known: bool = False

    @property
    def at(self) -> str:
        """At which rate the line is open, for a person; empty where it has none."""
        return f" at {self.bauds[0]} baud" if self.bauds else ""

    def restored(self) -> bytes:
        """Return the request that leaves the continuous mode as it was found."""
        return requests.stream(self.streamed) if self.streamed else requests.STOP


def contact(link: Gx1Link, found: ContactState) -> Part[str]:
    """Find the device: stop what it streams at one baud rate after the other. Return its serial number and firmware.

    Returns once one answers. The line is taken to be open at the first of the baud rates.
    """
    while True:
        heard: list[str] = []
        for number in range(max(1, len(found.bauds))):
            if number:
                found.bauds.append(found.bauds.pop(0))
                yield Reopen(f"no 3DM-GX1 at {found.bauds[-1]} baud, heard {heard[-1]}", found.bauds[0])
            # one that was there will be there again: look for it elsewhere only after a while
            for attempt in range(PATIENCE if found.known else 1):
                link.begin_anew()
                try:
                    yield from _hail(link, found, KNOWN_FLUSH_S if found.known and not attempt else FLUSH_S)
                    device = yield from _identity()
                except NoReplyError:
                    continue
                found.known = True
                return device
            found.known = False
            heard.append(link.heard())
        yield StationStatus(StationPhase.SILENT, _nobody(found.bauds, heard))
        yield Pause(RETRY_S)
        if len(found.bauds) > 1:
            found.bauds.append(found.bauds.pop(0))
            yield Reopen("no 3DM-GX1 found, trying again", found.bauds[0])


def _hail(link: Gx1Link, found: ContactState, flush: float) -> Part[None]:
    """Note what the device streams and stop it, within `flush` seconds. Two replies of one kind say that it streams."""
    listened = yield Listen(LISTEN_S, frozenset(DATA))
    kinds = [packet.command for packet in listened]
    if found.streamed is None:
        found.streamed = next((kind for kind in kinds if kinds.count(kind) > 1), None)
    if link.heard_bytes:
        # a stop may come amid a streamed reply: the second one is answered clearly
        yield Send(requests.STOP)
        yield Pause(flush)
    yield Ask(requests.STOP, value=0)
    if found.streamed is None:
        found.streamed = 0
    # what was listened to may have been noise that looked like replies
    link.watch.forget()


def _identity() -> Part[str]:
    (serial,) = yield Ask(requests.poll(CommandByte.SERIAL))
    (firmware,) = yield Ask(requests.poll(CommandByte.FIRMWARE))
    return f"3DM-GX1 serial {serial.unsigned}, firmware {version_text(firmware.unsigned)}"


def _nobody(bauds: Sequence[int], heard: Sequence[str]) -> str:
    # the attempts are over: the list of rates stands one turn before its beginning
    order = [f"at {baud} baud " for baud in (*bauds[1:], *bauds[:1])] or [""]
    attempts = "; ".join(f"{at}heard {what}" for at, what in zip(order, heard, strict=True))
    if all(what == "nothing" for what in heard):
        why = "check the device's power, the cable, and that the port is the right one"
    elif any("text" in what for what in heard):
        why = "what speaks in text is another device: check which port the 3DM-GX1 is on"
    elif bauds:
        why = "another device, or a baud rate that was not tried: check the port, and the list of baud rates"
    else:
        why = "another device, or the baud rate of the device server is not the 3DM-GX1's: check both"
    return f"no 3DM-GX1 answers on this line: {attempts}; {why}; trying again in {RETRY_S:g} s"


def read_word(address: int) -> Part[int]:
    """Read a word of the EEPROM, unsigned."""
    (reply,) = yield Ask(requests.read_eeprom(address))
    return reply.unsigned


def read_words(addresses: Iterable[int]) -> Part[tuple[int, ...]]:
    """Read words of the EEPROM, unsigned."""
    words: tuple[int, ...] = ()
    for address in addresses:
        words = (*words, (yield from read_word(address)))
    return words


def write_word(address: int, value: int) -> Part[None]:
    """Write a word of the EEPROM; the next one 10 ms later."""
    yield Ask(requests.write_eeprom(address, value))
    yield Pause(0.01)


def read_gains() -> Part[Gains]:
    """Read the gains. Raises UnusableError for those that no 3DM-GX1 can have.

    They are read twice: a reply does not say of which address it is, and one that comes late would pass for the next.
    """
    addresses = (Address.GYRO_GAIN, Address.ACCELEROMETER_GAIN, Address.MAGNETOMETER_GAIN)
    words = yield from read_words(addresses)
    again = yield from read_words(addresses)
    if words != again:
        raise UnusableError(
            f"the gains in its EEPROM were read twice, as {list(words)} and as {list(again)}: its replies come late or "
            "are damaged; check the cable, and the device server if there is one"
        )
    gyro, accelerometer, magnetometer = words
    if gyro == OLD_GYRO_GAIN:
        raise UnusableError(
            f"the gyro gain in its EEPROM (address {Address.GYRO_GAIN}) is {gyro}, that of a 3DM-G, the model before, "
            "whose scales are others: connect a 3DM-GX1"
        )
    for name, address, gain in (
        ("gyro", Address.GYRO_GAIN, gyro),
        ("accelerometer", Address.ACCELEROMETER_GAIN, accelerometer),
        ("magnetometer", Address.MAGNETOMETER_GAIN, magnetometer),
    ):
        if not GAINS[0] <= gain <= GAINS[1]:
            raise UnusableError(
                f"the {name} gain in its EEPROM (address {address}) is {gain}, and no 3DM-GX1 has one outside "
                f"{GAINS[0]} to {GAINS[1]}: the EEPROM is erased or damaged; write the gain "
                "from the device's calibration sheet to it"
            )
    return Gains(gyro, accelerometer, magnetometer)
