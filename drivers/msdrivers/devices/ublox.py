"""Driver of u-blox receivers: configures the binary protocol UBX, publishes fixes with their covariance.

The receiver is asked for its version (MON-VER). Generation 9 and later is configured by CFG-VALSET, earlier ones by
CFG-MSG and CFG-RATE, in volatile memory only; each message waits for its acknowledgement. An epoch is NAV-PVT with what
belongs to the same time of week: NAV-COV, NAV-HPPOSLLH, NAV-DOP and, of a moving base, NAV-RELPOSNED. It is published
at the end of the epoch (NAV-EOE), at the latest after `hold`.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from modelserver.messages import NAN, FixType, GpsSample, SensorHeader
from modelserver.transforms.so3 import Matrix3
from msdrivers.devices.gps.fixes import course_from_track
from msdrivers.devices.ranges import check_ranges
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send
from msdrivers.protocol import ublox
from msdrivers.protocol.recognition import recognize_line
from msdrivers.protocol.ublox import ReceiverSetup, UbxMessage, UbxStream

DEFAULT_BAUDS: Final = (38400, 9600, 115200, 460800)
"""Factory setting of generation 9, of earlier ones, and usual ones of configured receivers."""

FIXED: Final = 2
"""carrSoln: ambiguities fixed."""

QUOTED_BYTES: Final = 4096
"""First bytes of a line by which another device is recognized."""

_SECOND_NS: Final = 1_000_000_000
_WARNING_INTERVAL_NS: Final = 60 * _SECOND_NS
_MAX_ARRIVALS: Final = 4096

MOVING: Final = 0.3
"""Speed over ground above which a vehicle moves, m/s."""


@dataclass(frozen=True, slots=True)
class UbloxSettings:
    """Settings of a u-blox receiver. Raises ValueError with the key for an invalid value."""

    source: str
    rate_hz: float = 5.0
    """Fixes per second, 0.1 to 25; what a product reaches depends on its constellations."""
    bauds: tuple[int, ...] = ()
    """Baud rates to try; the line is opened at the first. Empty: 38400, 9600, 115200, 460800."""
    silence: float = 2.0
    """Timeout for fixes, seconds, after which the setup is repeated."""
    answer_timeout: float = 0.5
    """Timeout for the answer to a configuration message, seconds."""
    attempts: int = 3
    """How often an unanswered message is sent."""
    hold: float = 0.1
    """How long a position waits for the other messages of its epoch, seconds."""
    delay: float = 0.0
    """Shortest time from a fix to its first byte, seconds; it cannot be distinguished from the offset of the clocks."""
    delay_sigma: float = 0.02
    """Its standard deviation, seconds."""

    def __post_init__(self) -> None:
        check_ranges(self, rate_hz=(0.1, 25.0), silence=(0.1, 3600.0), answer_timeout=(0.05, 60.0), hold=(0.0, 10.0))
        check_ranges(self, delay=(0.0, 5.0), delay_sigma=(0.0, 5.0), attempts=(1, 100))
        if any(baud <= 0 for baud in self.bauds):
            raise ValueError(f"bauds are above 0, got {self.bauds}")
        if self.silence < 1.5 / self.rate_hz:
            raise ValueError(f"silence is at least 1.5 periods, {1.5 / self.rate_hz:g} s, got {self.silence:g}")


class Epoch:
    """The messages of one instant of the receiver, by name."""

    def __init__(self, itow: int, host_utime: int, deadline_ns: int):
        self.itow, self.host_utime, self.deadline_ns = itow, host_utime, deadline_ns
        self.parts: dict[str, Any] = {}

    def to_sample(self, header: SensorHeader) -> GpsSample:
        """Return the fix. The messages are in degrees, millimeters and millimeters per second."""
        pvt = self.parts["NAV-PVT"]
        fix_type = ublox.get_fix_type(pvt)
        has_place = ublox.has_place(pvt)
        latitude, longitude, height, msl = pvt.lat, pvt.lon, pvt.height * 1e-3, pvt.hMSL * 1e-3
        precise = self.parts.get("NAV-HPPOSLLH")
        if precise is not None and not precise.invalidLlh:
            latitude, longitude = precise.lat, precise.lon
            height, msl = precise.height * 1e-3, precise.hMSL * 1e-3
        dop = self.parts.get("NAV-DOP")
        position, velocity = self._find_covariances(pvt)
        yaw, yaw_sigma = self._find_baseline()
        return GpsSample(
            header,
            fix_type,
            latitude if has_place else NAN,
            longitude if has_place else NAN,
            height_ellipsoidal=height if has_place else NAN,
            height_msl=msl if has_place else NAN,
            undulation=height - msl if has_place else NAN,
            satellites=pvt.numSV,
            hdop=NAN if dop is None else dop.hDOP,
            vdop=NAN if dop is None else dop.vDOP,
            pdop=pvt.pDOP,
            position_covariance=position if has_place else None,
            velocity=(pvt.velE * 1e-3, pvt.velN * 1e-3, -pvt.velD * 1e-3) if has_place else None,
            velocity_covariance=velocity if has_place else None,
            velocity_latency=0.0 if has_place else NAN,
            speed=pvt.gSpeed * 1e-3 if has_place else NAN,
            course=course_from_track(pvt.headMot) if has_place and pvt.gSpeed * 1e-3 > MOVING else NAN,
            baseline_yaw=yaw,
            baseline_yaw_sigma=yaw_sigma,
        )

    def _find_covariances(self, pvt: Any) -> tuple[Matrix3 | None, Matrix3 | None]:
        """Return those of position (m2) and velocity (m2/s2) along east, north, up.

        Without NAV-COV the horizontal accuracy is shared by both axes, as the length of a circular error; that of the
        speed is taken for each pair of axes in the same way.
        """
        cov = self.parts.get("NAV-COV")
        a, b, c = pvt.hAcc * 1e-3, pvt.vAcc * 1e-3, pvt.sAcc * 1e-3
        position: Matrix3 | None = (a * a / 2, 0.0, 0.0, 0.0, a * a / 2, 0.0, 0.0, 0.0, b * b)
        velocity: Matrix3 | None = (c * c / 2, 0.0, 0.0, 0.0, c * c / 2, 0.0, 0.0, 0.0, c * c / 2)
        if cov is not None and cov.posCovValid:
            position = _to_enu(*(getattr(cov, f"posCov{axes}") for axes in _AXES))
        if cov is not None and cov.velCovValid:
            velocity = _to_enu(*(getattr(cov, f"velCov{axes}") for axes in _AXES))
        return position if a > 0.0 else None, velocity if c > 0.0 else None

    def _find_baseline(self) -> tuple[float, float]:
        """Return the direction to the moving base's antenna and its sigma, radians; nan if it is not known.

        NAV-RELPOSNED has the vector from the base to this antenna, whose position NAV-PVT gives.
        """
        relative = self.parts.get("NAV-RELPOSNED")
        if relative is None or not (relative.isMoving and relative.carrSoln == FIXED):
            return NAN, NAN
        if not (relative.relPosValid and getattr(relative, "relPosHeadingValid", 0)):
            return NAN, NAN
        return course_from_track(relative.relPosHeading + 180.0), math.radians(relative.accHeading)


_AXES: Final = ("NN", "NE", "ND", "EE", "ED", "DD")


def _to_enu(nn: float, ne: float, nd: float, ee: float, ed: float, dd: float) -> Matrix3:
    return (ee, ne, -ed, ne, nn, -nd, -ed, -nd, dd)


class UbloxDriver:
    """An `Endpoint` of bytes at the host's end of a receiver's line; see `UbloxSettings`."""

    def __init__(self, settings: UbloxSettings) -> None:
        self._settings = settings
        self.max_silence = settings.silence
        self._bauds = settings.bauds or DEFAULT_BAUDS
        self._stream = UbxStream()
        self._phase, self._reported = EndpointPhase.WAITING, ""
        self._product = ""
        self._setups: tuple[ReceiverSetup, ...] = ()
        self._index = self._attempt = 0
        self._setup_deadline_ns: int | None = None
        self._is_asking_version = False
        self._silence_deadline_ns = 0
        self._epoch: Epoch | None = None
        self._last_itow: int | None = None
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_MAX_ARRIVALS)
        self._first_bytes = b""
        self._baud_index = 0
        self._tried: list[str] = []
        self._next_warning_ns = 0
        self._seq = self._seq_at_setup = 0
        self._counts: Counter[str] = Counter()

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages by kind, `rejected.<reason>`, `samples`, `rtcm.used`, `rtcm.unused`, `rtcm.damaged`."""
        return {**self._stream.counts, **self._counts}

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Discard incomplete data and ask for the version."""
        self._stream.clear()
        self._arrivals.clear()
        self._epoch, self._first_bytes = None, b""
        # no new status within a search over the baud rates
        searching = self._tried or self._phase is EndpointPhase.SILENT
        status = [] if searching else self._set_status(EndpointPhase.WAITING, "waiting for a receiver")
        return [*status, *self._ask_version(now)]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        """Process received bytes."""
        self._arrivals.append((self._stream.offset, now.utime))
        if len(self._first_bytes) < QUOTED_BYTES:
            self._first_bytes += unit[: QUOTED_BYTES - len(self._first_bytes)]
        return [output for message in self._stream.feed(unit) for output in self._on_message(message, now)]

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Do what is due."""
        out: list[Output[bytes]] = []
        if self._epoch is not None and now.monotonic_ns >= self._epoch.deadline_ns:
            out += self._publish(now)
        if self._setup_deadline_ns is not None and now.monotonic_ns >= self._setup_deadline_ns:
            return [*out, *self._on_unanswered(now)]
        if self._setup_deadline_ns is None and now.monotonic_ns >= self._silence_deadline_ns:
            text = f"no NAV-PVT for {self._settings.silence:g} s, setting the receiver up again"
            out += [*self._set_status(EndpointPhase.SILENT, text), *self._ask_version(now)]
        return out

    def get_deadline(self) -> int | None:
        """Return when to call `on_timer`, monotonic nanoseconds."""
        setup = self._setup_deadline_ns
        times = [self._silence_deadline_ns if setup is None else setup]
        return min(times + ([] if self._epoch is None else [self._epoch.deadline_ns]))

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        """Leave the receiver as it is: its volatile configuration is lost with its power."""
        return []

    def _set_status(self, phase: EndpointPhase, text: str, *, is_warning: bool = False) -> list[Output[bytes]]:
        """Report a status unless it is unchanged."""
        if (phase, text) == (self._phase, self._reported):
            return []
        self._phase, self._reported = phase, text
        return [EndpointStatus(phase, text, is_warning)]

    # --- setup ---

    def _ask_version(self, now: HostTime) -> list[Output[bytes]]:
        self._is_asking_version, self._setups, self._index, self._attempt = True, (), 0, 1
        self._seq_at_setup = self._seq
        self._setup_deadline_ns = now.monotonic_ns + round(self._settings.answer_timeout * _SECOND_NS)
        return [Send(ublox.make_version_poll())]

    def _send_setup(self, now: HostTime) -> list[Output[bytes]]:
        """Send the next configuration message; after the last one fixes must come."""
        if self._index == len(self._setups):
            self._setup_deadline_ns = None
            self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * _SECOND_NS)
            return self._set_status(EndpointPhase.CONFIGURING, f"{self._product} is set up, waiting for NAV-PVT")
        self._attempt += 1
        self._setup_deadline_ns = now.monotonic_ns + round(self._settings.answer_timeout * _SECOND_NS)
        return [Send(self._setups[self._index].frame)]

    def _next_setup(self, now: HostTime) -> list[Output[bytes]]:
        self._index, self._attempt = self._index + 1, 0
        return self._send_setup(now)

    def _on_version(self, version: Any, now: HostTime) -> list[Output[bytes]]:
        if not self._is_asking_version:
            return []
        self._is_asking_version, self._tried = False, []
        self._product, protocol = ublox.get_protocol_version(version)
        self._setups, self._index, self._attempt = ublox.make_setup(protocol, self._settings.rate_hz), 0, 0
        words = f"{self._product}, protocol {protocol:g}, answers; setting it up"
        return [*self._set_status(EndpointPhase.CONFIGURING, words), *self._send_setup(now)]

    def _on_acknowledgement(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        if self._is_asking_version or self._index >= len(self._setups):
            return []
        setup = self._setups[self._index]
        if (message.values.clsID, message.values.msgID) != setup.key:
            return []
        out: list[Output[bytes]] = []
        if message.name == "ACK-NAK":
            if setup.is_optional:
                self._counts["optional_rejected"] += 1
            else:
                text = f"the receiver rejected {setup.what}; is `rate_hz` within what this product reaches?"
                out += self._set_status(EndpointPhase.CONFIGURING, text, is_warning=True)
        return [*out, *self._next_setup(now)]

    def _on_unanswered(self, now: HostTime) -> list[Output[bytes]]:
        """Repeat a message without an answer; after the last attempt use what arrives, else try the next baud rate."""
        if self._attempt < self._settings.attempts:
            if not self._is_asking_version:
                return self._send_setup(now)
            self._attempt += 1
            self._setup_deadline_ns = now.monotonic_ns + round(self._settings.answer_timeout * _SECOND_NS)
            return [Send(ublox.make_version_poll())]
        if not self._is_asking_version:
            return self._next_setup(now)
        self._setup_deadline_ns, self._is_asking_version = None, False
        self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * _SECOND_NS)
        if self._seq > self._seq_at_setup:
            text = "the receiver sends fixes but answers nothing: using what it sends; can the line send to it?"
            return self._set_status(EndpointPhase.STREAMING, text)
        return self._try_next_baud(now)

    def _try_next_baud(self, now: HostTime) -> list[Output[bytes]]:
        found = recognize_line(self._first_bytes, "ublox")
        baud = self._bauds[self._baud_index]
        self._tried.append(f"at {baud} baud {found}")
        out: list[Output[bytes]] = []
        if len(self._tried) >= len(self._bauds):
            if self._phase is not EndpointPhase.SILENT or now.monotonic_ns >= self._next_warning_ns:
                self._next_warning_ns = now.monotonic_ns + _WARNING_INTERVAL_NS
                text = f"no u-blox receiver answers on this line: {'; '.join(self._tried)}"
                out += self._set_status(EndpointPhase.SILENT, text)
            self._tried = []
        self._baud_index = (self._baud_index + 1) % len(self._bauds)
        return [*out, Reopen(f"no u-blox receiver at {baud} baud, {found}", self._bauds[self._baud_index])]

    # --- messages ---

    def _on_message(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        if message.name == "MON-VER":
            return self._on_version(message.values, now)
        if message.name.startswith("ACK"):
            return self._on_acknowledgement(message, now)
        if message.name == "RXM-RTCM":
            use = "damaged" if message.values.crcFailed else "used" if message.values.msgUsed == 2 else "unused"
            self._counts[f"rtcm.{use}"] += 1
            return []
        return self._on_epoch_part(message, now)

    def _on_epoch_part(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        """Add a message to the epoch of its time of week; a later one, or NAV-EOE, completes the one before."""
        itow = message.values.iTOW
        out: list[Output[bytes]] = []
        if self._epoch is not None and self._epoch.itow != itow:
            out += self._publish(now)
        if self._epoch is None:
            if itow == self._last_itow:
                if message.name == "NAV-PVT":
                    self._counts["repeated"] += 1
                return out
            start = message.start
            arrival = next((at for offset, at in reversed(self._arrivals) if offset <= start), now.utime)
            self._epoch = Epoch(itow, arrival, now.monotonic_ns + round(self._settings.hold * _SECOND_NS))
        self._epoch.parts[message.name] = message.values
        if message.name == "NAV-EOE":
            out += self._publish(now)
        return out

    def _publish(self, now: HostTime) -> list[Output[bytes]]:
        """Publish the pending epoch, if it has a position."""
        epoch, self._epoch = self._epoch, None
        assert epoch is not None
        self._last_itow = epoch.itow
        if "NAV-PVT" not in epoch.parts:
            return []
        header = SensorHeader(
            0, self._settings.source, self._seq, epoch.host_utime, ublox.get_utime(epoch.parts["NAV-PVT"])
        )
        self._seq += 1
        self._counts["samples"] += 1
        self._tried = []
        self._silence_deadline_ns = now.monotonic_ns + round(self._settings.silence * _SECOND_NS)
        sample = epoch.to_sample(header)
        out: list[Output[bytes]] = [MeasuredSample(sample, self._settings.delay, self._settings.delay_sigma)]
        if self._setup_deadline_ns is None and self._phase is not EndpointPhase.STREAMING:
            self._counts["no_fix"] += sample.fix_type is FixType.NONE
            out += self._set_status(EndpointPhase.STREAMING, f"{self._product or 'a receiver'}, receiving NAV-PVT")
        return out
