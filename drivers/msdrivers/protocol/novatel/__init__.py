"""NovAtel OEM4 and successors: contents of logs, with the names of the manuals; command responses and prompts.

Numbers that are not in these tables, of newer receivers, stay plain numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, TypeAlias


class TimeStatus(IntEnum):
    """Quality of the receiver's GPS time."""

    UNKNOWN = 20
    APPROXIMATE = 60
    COARSEADJUSTING = 80
    COARSE = 100
    COARSESTEERING = 120
    FREEWHEELING = 130
    FINEADJUSTING = 140
    FINE = 160
    FINEBACKUPSTEERING = 170
    FINESTEERING = 180
    SATTIME = 200


class SolutionStatus(IntEnum):
    """Whether a solution was computed, or why not."""

    SOL_COMPUTED = 0
    INSUFFICIENT_OBS = 1
    NO_CONVERGENCE = 2
    SINGULARITY = 3
    COV_TRACE = 4
    TEST_DIST = 5
    COLD_START = 6
    V_H_LIMIT = 7
    VARIANCE = 8
    RESIDUALS = 9
    INTEGRITY_WARNING = 13
    PENDING = 18
    INVALID_FIX = 19
    UNAUTHORIZED = 20


class PositionType(IntEnum):
    """Type of a position or velocity solution."""

    NONE = 0
    FIXEDPOS = 1
    FIXEDHEIGHT = 2
    FLOATCONV = 4
    WIDELANE = 5
    NARROWLANE = 6
    DOPPLER_VELOCITY = 8
    SINGLE = 16
    PSRDIFF = 17
    WAAS = 18
    PROPAGATED = 19
    OMNISTAR = 20
    L1_FLOAT = 32
    IONOFREE_FLOAT = 33
    NARROW_FLOAT = 34
    L1_INT = 48
    WIDE_INT = 49
    NARROW_INT = 50
    RTK_DIRECT_INS = 51
    INS_SBAS = 52
    INS_PSRSP = 53
    INS_PSRDIFF = 54
    INS_RTKFLOAT = 55
    INS_RTKFIXED = 56
    OMNISTAR_HP = 64
    OMNISTAR_XP = 65
    CDGPS = 66
    PPP_CONVERGING = 68
    PPP = 69
    INS_PPP_CONVERGING = 73
    INS_PPP = 74
    PPP_BASIC_CONVERGING = 77
    PPP_BASIC = 78
    INS_PPP_BASIC_CONVERGING = 79
    INS_PPP_BASIC = 80


class LogHeader(NamedTuple):
    """Header of a log.

    name: e.g. "BESTPOS", or "id 1234" for an unknown binary log. week may be rolled over, see `gps_time`.
    milliseconds: of the week. time_status: a `TimeStatus`; UNKNOWN for a short header.
    port: as ASCII names it, or the binary address's number. antenna: the measurement source; 1 is the secondary
    antenna, which ASCII writes as a suffix of the name (`BESTPOSA_1`). Older boards send others, which mean none.
    """

    name: str
    week: int
    milliseconds: int
    time_status: int
    port: str
    sequence: int
    receiver_status: int
    is_binary: bool
    antenna: int = 0

    @property
    def label(self) -> str:
        """The name as receivers write it: `BESTPOSB`, `BESTPOSA_1`."""
        return f"{self.name}{'B' if self.is_binary else 'A'}{'_1' if self.is_secondary else ''}"

    @property
    def is_secondary(self) -> bool:
        """Whether the log is of the secondary antenna."""
        return self.antenna == 1


class Position(NamedTuple):
    """Body of BESTPOS, PSRPOS and RTKPOS. Degrees; meters; ages in seconds; sigmas along north, east and up.

    height is above mean sea level; above the ellipsoid it is `height + undulation`.
    """

    status: int
    type: int
    latitude: float
    longitude: float
    height: float
    undulation: float
    datum: int
    sigma_latitude: float
    sigma_longitude: float
    sigma_height: float
    station: str
    differential_age: float
    solution_age: float
    tracked: int
    used: int


class Velocity(NamedTuple):
    """Body of BESTVEL. latency: seconds to take off the header's time. m/s, up positive; track: degrees clockwise from
    true north."""

    status: int
    type: int
    latency: float
    age: float
    horizontal: float
    track: float
    vertical: float


class UtmPosition(NamedTuple):
    """Body of BESTUTM. Meters; zone by number and letter; otherwise as `Position`."""

    status: int
    type: int
    zone: int
    letter: str
    northing: float
    easting: float
    height: float
    undulation: float
    datum: int
    sigma_northing: float
    sigma_easting: float
    sigma_height: float
    station: str
    differential_age: float
    solution_age: float
    tracked: int
    used: int


class HeadingLog(NamedTuple):
    """Body of HEADING and HEADING2: from the antenna whose position is given to the other one.

    length: meters, -1 if unknown. Degrees; heading clockwise from true north.
    """

    status: int
    type: int
    length: float
    heading: float
    pitch: float
    sigma_heading: float
    sigma_pitch: float
    station: str
    tracked: int
    used: int


Body: TypeAlias = Position | Velocity | UtmPosition | HeadingLog


class NovatelLog(NamedTuple):
    """A log whose checksum is right. body: None for a log that is not read here. start: bytes from the beginning of
    the stream to its first byte."""

    header: LogHeader
    body: Body | None
    start: int = 0


MESSAGE_IDS = {
    37: "VERSION",
    42: "BESTPOS",
    47: "PSRPOS",
    93: "RXSTATUS",
    99: "BESTVEL",
    101: "TIME",
    141: "RTKPOS",
    174: "PSRDOP",
    241: "BESTXYZ",
    264: "INSCOV",
    508: "INSPVAS",
    726: "BESTUTM",
    812: "CORRIMUDATA",
    971: "HEADING",
    1163: "PSRDOP2",
    1335: "HEADING2",
    1465: "INSPVAX",
}

MAX_ANTENNA = 31
"""The largest measurement source: five bits of a binary log's message type."""

DATUMS = {"WGS84": 61}
"""Datum names of ASCII logs to the numbers of binary ones; others become 0, for the driver takes WGS 84 only."""


@dataclass(frozen=True, slots=True)
class CommandResponse:
    """Response to a command. error: its text, empty for `<OK`."""

    start: int
    error: str = ""

    @property
    def is_ok(self) -> bool:
        return not self.error


@dataclass(frozen=True, slots=True)
class Prompt:
    """`[COM1]`: follows every answer, and greets after the receiver has started."""

    start: int
    port: str
