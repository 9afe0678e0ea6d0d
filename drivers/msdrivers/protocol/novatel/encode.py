"""Encode NovAtel logs, as the receiver does."""

from __future__ import annotations

from collections.abc import Sequence

from msdrivers.protocol.novatel import binary
from msdrivers.protocol.novatel.ascii import UNKNOWN_VALUE
from msdrivers.protocol.novatel.binary import crc32
from msdrivers.protocol.novatel.logs import (
    DATUMS,
    MESSAGE_IDS,
    Body,
    HeadingLog,
    NovatelLog,
    Position,
    PositionType,
    SolutionStatus,
    TimeStatus,
    UtmPosition,
    Velocity,
)

_IDS = {name: ident for ident, name in MESSAGE_IDS.items()}
_PORTS = {"COM1": 32, "COM2": 64, "COM3": 96}
_BUILD = 0


def encode(log: NovatelLog) -> bytes:
    """Encode a log with a long header, binary or ASCII by `log.header.is_binary`.

    Raises:
        ValueError: a log without body, or one whose name has no number.
    """
    if log.body is None or log.header.name not in _IDS:
        raise ValueError(f"{log.header.name} cannot be written")
    return _encode_binary(log, log.body) if log.header.is_binary else _encode_ascii(log, log.body)


def _encode_binary(log: NovatelLog, body: Body) -> bytes:
    header = log.header
    content = _pack_body(header.name, body)
    port = _PORTS.get(header.port) or (int(header.port) if header.port.isdecimal() else 0)
    frame = binary.LONG_HEADER.pack(
        b"\xaa\x44\x12",
        binary.LONG_HEADER.size,
        _IDS[header.name],
        header.antenna,
        port,
        len(content),
        header.sequence,
        0,
        header.time_status,
        header.week,
        header.milliseconds,
        header.receiver_status,
        0,
        _BUILD,
    )
    frame += content
    return frame + crc32(frame).to_bytes(4, "little")


def _pack_body(name: str, body: Body) -> bytes:
    match body:
        case Position():
            return binary.POSITION.pack(*body[:10], body.station.encode("ascii"), *body[11:])
        case Velocity():
            return binary.VELOCITY.pack(*body, 0.0)
        case UtmPosition():
            head = (body.status, body.type, body.zone, ord(body.letter), *body[4:12])
            return binary.UTM.pack(*head, body.station.encode("ascii"), *body[13:])
        case HeadingLog():
            layout = binary.HEADING if name == "HEADING" else binary.HEADING2
            return layout.pack(*body[:7], body.station.encode("ascii"), *body[8:])


def _encode_ascii(log: NovatelLog, body: Body) -> bytes:
    header = log.header
    status = TimeStatus(header.time_status).name
    head = (
        f"{header.label},{header.port or 'COM1'},{header.sequence},0.0,{status},{header.week},"
        f"{header.milliseconds / 1000.0:.3f},{header.receiver_status:08x},0000,{_BUILD}"
    )
    text = f"{head};{','.join(_format_fields(header.name, body))}"
    return f"#{text}*{crc32(text.encode('ascii')):08x}\r\n".encode("ascii")


def _format_fields(name: str, body: Body) -> Sequence[str]:
    solution = (_solution_name(body.status), _type_name(body.type))
    match body:
        case Position(datum=datum, station=station):
            place = (f"{body.latitude:.11f}", f"{body.longitude:.11f}", f"{body.height:.4f}", f"{body.undulation:.4f}")
            return (
                *solution,
                *place,
                _datum_name(datum),
                *_format_sigmas(body),
                f'"{station}"',
                *_format_ages(body),
                *_TRAILING_FIELDS,
            )
        case UtmPosition(datum=datum, station=station):
            zone = (str(body.zone), body.letter)
            place = (f"{body.northing:.4f}", f"{body.easting:.4f}", f"{body.height:.4f}", f"{body.undulation:.4f}")
            return (
                *solution,
                *zone,
                *place,
                _datum_name(datum),
                *_format_sigmas(body),
                f'"{station}"',
                *_format_ages(body),
                *_TRAILING_FIELDS,
            )
        case Velocity():
            ages = (f"{body.latency:.3f}", f"{body.age:.3f}")
            return (*solution, *ages, f"{body.horizontal:.4f}", f"{body.track:.6f}", f"{body.vertical:.4f}", "0.0")
        case HeadingLog():
            angles = (f"{body.length:.4f}", f"{body.heading:.6f}", f"{body.pitch:.6f}", "0.0")
            sigmas = (f"{body.sigma_heading:.4f}", f"{body.sigma_pitch:.4f}")
            stations = (f'"{body.station}"',) if name == "HEADING" else (f'"{body.station}"', '""')
            return (*solution, *angles, *sigmas, *stations, str(body.tracked), str(body.used), *_TRAILING_FIELDS)


_TRAILING_FIELDS = ("0", "0", "0", "00", "00", "00")
"""Counts of observations and masks that end several logs."""


def _format_sigmas(body: Position | UtmPosition) -> Sequence[str]:
    sigmas = body[7:10] if isinstance(body, Position) else body[9:12]
    return tuple(f"{sigma:.4f}" for sigma in sigmas)


def _format_ages(body: Position | UtmPosition) -> Sequence[str]:
    return (f"{body.differential_age:.3f}", f"{body.solution_age:.3f}", str(body.tracked), str(body.used))


def _datum_name(number: int) -> str:
    return next((name for name, each in DATUMS.items() if each == number), "USER")


def _solution_name(number: int) -> str:
    return SolutionStatus(number).name if number != UNKNOWN_VALUE else "UNKNOWN"


def _type_name(number: int) -> str:
    return PositionType(number).name if number != UNKNOWN_VALUE else "UNKNOWN"
