"""Settings of the driver of a satellite receiver."""

from __future__ import annotations

from dataclasses import dataclass

PROTOCOLS = ("novatel", "nmea")
FORMATS = ("binary", "ascii")
POSITION_LOGS = ("BESTPOS", "RTKPOS", "PSRPOS")
HEADING_LOGS = ("", "HEADING", "HEADING2")


@dataclass(frozen=True, slots=True)
class GpsSettings:
    """Settings of the receiver. Seconds; raises ValueError with the key for an invalid value.

    protocol: "novatel" configures the receiver by commands; "nmea" only sends `commands` and reads.
    rate_hz: of the logs that a NovAtel receiver is asked for, 0.1 to 20. log_format: "binary" or "ascii".
    position_log: source of the position; NMEA positions are used only while it is missing.
    heading_log: of a dual-antenna receiver, empty for none. device_port: the receiver's port, as its commands name it.
    commands: lines sent before the logs are asked for, e.g. "fix none"; with "nmea" they are not acknowledged.
    bauds: the rates to try; the line is opened at the first. Empty: the line has none, or one that is right.
    silence: timeout for fixes, after which the setup is repeated.
    answer_timeout: for the response to a command, which is sent `attempts` times.
    hold: how long a position waits for the velocity of its instant. gap: pause of the line after which the sentences of
    an instant are complete.
    delay: shortest time from a fix to the first byte of its log, mostly the receiver's processing; it cannot be
    distinguished from the offset of the clocks. delay_sigma: its standard deviation.
    restore_on_exit: stop the logs that were asked for when the driver leaves.
    """

    source: str
    protocol: str = "novatel"
    rate_hz: float = 4.0
    log_format: str = "binary"
    position_log: str = "BESTPOS"
    heading_log: str = ""
    device_port: str = "thisport"
    commands: tuple[str, ...] = ()
    bauds: tuple[int, ...] = ()
    silence: float = 2.0
    answer_timeout: float = 1.0
    attempts: int = 3
    hold: float = 0.1
    gap: float = 0.04
    restore_on_exit: bool = True
    delay: float = 0.0
    delay_sigma: float = 0.02

    def __post_init__(self) -> None:
        for name, value, known in (
            ("protocol", self.protocol, PROTOCOLS),
            ("log_format", self.log_format, FORMATS),
            ("position_log", self.position_log, POSITION_LOGS),
            ("heading_log", self.heading_log, HEADING_LOGS),
        ):
            if value not in known:
                raise ValueError(f"{name}: must be one of {', '.join(filter(None, known))}, got '{value}'")
        if not 0.1 <= self.rate_hz <= 20.0:
            raise ValueError(f"rate_hz: must be 0.1 to 20 Hz, got {self.rate_hz:g}")
        if any(baud <= 0 for baud in self.bauds):
            raise ValueError(f"bauds: must be above 0, got {self.bauds}")
        if self.attempts < 1:
            raise ValueError(f"attempts: must be at least 1, got {self.attempts}")
        for command in self.commands:
            if not command.strip() or not command.isprintable() or not command.isascii():
                raise ValueError(f"commands: {command!r} is no line of text")
        for name, seconds, least in (
            ("silence", self.silence, 0.1),
            ("answer_timeout", self.answer_timeout, 0.05),
            ("hold", self.hold, 0.0),
            ("gap", self.gap, 0.001),
            ("delay", self.delay, 0.0),
            ("delay_sigma", self.delay_sigma, 0.0),
        ):
            if not least <= seconds <= 3600.0:
                raise ValueError(f"{name}: must be {least:g} to 3600 s, got {seconds:g}")
        if self.silence < 1.5 / self.rate_hz:
            raise ValueError(
                f"silence: {self.silence:g} s is less than one and a half periods at {self.rate_hz:g} Hz; make it "
                f"{2.0 / self.rate_hz:g} s or more"
            )

    @property
    def logs(self) -> tuple[str, ...]:
        """The names of the logs that a NovAtel receiver is asked for."""
        if self.protocol != "novatel":
            return ()
        return (self.position_log, "BESTVEL", *((self.heading_log,) if self.heading_log else ()))

    def make_setup_commands(self) -> tuple[str, ...]:
        """Return the commands that set the receiver up, in order."""
        if self.protocol != "novatel":
            return self.commands
        wanted = (f"log {self.device_port} {log} ontime {1.0 / self.rate_hz:.6g}" for log in self._list_log_names())
        return (f"unlogall {self.device_port}", *self.commands, *wanted)

    def make_undo_commands(self) -> tuple[str, ...]:
        """Return the commands that stop the logs again."""
        return tuple(f"unlog {self.device_port} {log}" for log in self._list_log_names())

    def _list_log_names(self) -> tuple[str, ...]:
        return tuple(log.lower() + ("b" if self.log_format == "binary" else "a") for log in self.logs)
