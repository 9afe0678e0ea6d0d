"""Driver of u-blox receivers: configures the binary protocol UBX, publishes fixes with their covariance.

The receiver is asked for its version (MON-VER). Generation 9 and later is configured by CFG-VALSET, earlier ones by
CFG-MSG and CFG-RATE, in volatile memory only; each message waits for its acknowledgement. An epoch is NAV-PVT with what
belongs to the same time of week: NAV-COV, NAV-HPPOSLLH, NAV-DOP and, of a moving base, NAV-RELPOSNED. It is published
at the end of the epoch (NAV-EOE), at the latest after `hold`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from modelserver.messages import NAN, GpsSample, SensorHeader
from modelserver.transforms.so3 import Matrix3
from msdrivers.devices.gps.fixes import course_from_track
from msdrivers.devices.ranges import check_ranges
from msdrivers.devices.stream_driver import SECOND_NS, StreamDriver, check_stream_settings
from msdrivers.endpoint import HostTime, Output
from msdrivers.protocol import ublox
from msdrivers.protocol.ublox import UbxMessage, UbxStream

FIXED: Final = 2
"""carrSoln: ambiguities fixed."""

MOVING: Final = 0.3
"""Speed over ground above which a vehicle moves, m/s."""


@dataclass(frozen=True, slots=True)
class UbloxSettings:
    """Settings of a u-blox receiver. Raises ValueError with the key for an invalid value."""

    source: str
    rate_hz: float = 5.0
    """Fixes per second, 0.1 to 25; what a product reaches depends on its constellations."""
    bauds: tuple[int, ...] = (38400, 9600, 115200, 460800)
    """Baud rates to try; the line is opened at the first. Empty: the line has none."""
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
        check_stream_settings(self)
        check_ranges(self, rate_hz=(0.1, 25.0), hold=(0.0, 10.0))
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


class UbloxDriver(StreamDriver[UbxMessage]):
    """An `Endpoint` of bytes at the host's end of a receiver's line; see `UbloxSettings`.

    Further counts: `rtcm.used`, `rtcm.unused`, `rtcm.damaged`, and `repeated` instants.
    """

    device = "ublox"
    description = "u-blox receiver"
    awaited = "NAV-PVT"

    def __init__(self, settings: UbloxSettings) -> None:
        super().__init__(settings, UbxStream())
        self._rate_hz, self._hold_ns = settings.rate_hz, round(settings.hold * SECOND_NS)
        self._epoch: Epoch | None = None
        self._last_itow: int | None = None

    def _make_identification(self) -> bytes:
        return ublox.make_version_poll()

    def _on_start(self) -> None:
        self._epoch = None

    def _get_extra_deadline(self) -> int | None:
        return None if self._epoch is None else self._epoch.deadline_ns

    def _on_extra_timer(self, now: HostTime) -> list[Output[bytes]]:
        return self._publish_epoch(now)

    def _on_message(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        if message.name == "MON-VER":
            product, protocol = ublox.get_protocol_version(message.values)
            steps = ublox.make_setup(protocol, self._rate_hz)
            return self._on_identity(f"{product} (protocol {protocol:g})", steps, now)
        if message.name.startswith("ACK"):
            return self._on_command_answer(message, now)
        if message.name == "RXM-RTCM":
            use = "damaged" if message.values.crcFailed else "used" if message.values.msgUsed == 2 else "unused"
            self._counts[f"rtcm.{use}"] += 1
            return []
        return self._on_epoch_part(message, now)

    def _on_command_answer(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        step = self._step
        if step is None or bytes((message.values.clsID, message.values.msgID)) != step.frame[2:4]:
            return []
        is_rejected = message.name == "ACK-NAK"
        return self._on_acknowledgement(now, "is `rate_hz` within what this product reaches?" if is_rejected else "")

    def _on_epoch_part(self, message: UbxMessage, now: HostTime) -> list[Output[bytes]]:
        """Add a message to the epoch of its time of week; a later one, or NAV-EOE, completes the one before."""
        itow = message.values.iTOW
        out: list[Output[bytes]] = []
        if self._epoch is not None and self._epoch.itow != itow:
            out += self._publish_epoch(now)
        if self._epoch is None:
            if itow == self._last_itow:
                if message.name == "NAV-PVT":
                    self._counts["repeated"] += 1
                return out
            self._epoch = Epoch(itow, self._find_arrival(message.start, now), now.monotonic_ns + self._hold_ns)
        self._epoch.parts[message.name] = message.values
        if message.name == "NAV-EOE":
            out += self._publish_epoch(now)
        return out

    def _publish_epoch(self, now: HostTime) -> list[Output[bytes]]:
        epoch, self._epoch = self._epoch, None
        assert epoch is not None
        self._last_itow = epoch.itow
        if "NAV-PVT" not in epoch.parts:
            return []
        header = self._make_header(epoch.host_utime, ublox.get_utime(epoch.parts["NAV-PVT"]))
        return self._publish(epoch.to_sample(header), now)
