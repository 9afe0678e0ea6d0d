"""The serial protocol of the MicroStrain 3DM-GX1, from both sides: requests, replies, their parser, ticks, scaling.

A reply is the echo of the command byte, big-endian 16-bit words, mostly the timer ticks, and a checksum: the first byte
plus every 16-bit word after it, modulo 65536. There is no sync byte, so random bytes pass for a reply one time in
65,536. A reply therefore counts only if its command is streamed or expected, its checksum is right and the validator
accepts it; else one byte is skipped and the search continues. At most 30 bytes are buffered. Requests carry no
checksum.

The 16-bit ticks are unwrapped, and reject byte sequences that only look like a reply: they are plausible if they are
ahead of the previous ones by no more than the elapsed time (plus 0.5 s). They may be ahead by less: replies that a busy
host reads late arrive all at once. Three consecutive implausible replies that agree with each other mean that the
counter has jumped.

Scaling: a vector's word times its gain (a word of the EEPROM) by 32768000 is gauss, g or rad/s. Source: MicroStrain,
"3DM-GX1 Data Communications Protocol", and public drivers that follow it.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from itertools import accumulate
from typing import NamedTuple

from modelserver.transforms import so3
from modelserver.transforms.so3 import Quaternion, Vector3


def append_checksum(body: bytes) -> bytes:
    """Return a reply, a command byte and big-endian 16-bit words, with its checksum behind it.

    Raises ValueError for a body of even length.
    """
    if len(body) % 2 == 0:
        raise ValueError(f"a reply is a byte and whole words before its checksum, got {len(body)} bytes")
    words: tuple[int, ...] = struct.unpack(f">B{len(body) // 2}H", body)
    return body + (sum(words) & 0xFFFF).to_bytes(2, "big")


class CommandByte(IntEnum):
    """The command byte of a request, and of the reply to it."""

    STABILIZED_VECTORS = 0x02
    INSTANTANEOUS_VECTORS = 0x03
    CAPTURE_BIAS = 0x06
    TEMPERATURE = 0x07
    QUATERNION_VECTORS = 0x0C
    INSTANTANEOUS_EULER = 0x0D
    STABILIZED_EULER = 0x0E
    CONTINUOUS = 0x10
    READ_EEPROM = 0x28
    EULER_VECTORS = 0x31
    FIRMWARE = 0xF0
    SERIAL = 0xF1


class ReplyLayout(NamedTuple):
    """Content of a reply between the command byte and the checksum: fields with their numbers of words, ticks."""

    fields: tuple[tuple[str, int], ...]
    has_ticks: bool = True

    @property
    def words(self) -> int:
        return sum(count for _, count in self.fields)

    @property
    def length(self) -> int:
        """Length of the reply in bytes."""
        return 1 + 2 * self.words + 2 * self.has_ticks + 2


_VECTORS = (("field", 3), ("acceleration", 3), ("rate", 3))

LAYOUTS: dict[int, ReplyLayout] = {
    CommandByte.STABILIZED_VECTORS: ReplyLayout(_VECTORS),
    CommandByte.INSTANTANEOUS_VECTORS: ReplyLayout(_VECTORS),
    CommandByte.CAPTURE_BIAS: ReplyLayout(()),
    CommandByte.TEMPERATURE: ReplyLayout((("temperature", 1),)),
    CommandByte.QUATERNION_VECTORS: ReplyLayout((("quaternion", 4), *_VECTORS)),
    CommandByte.INSTANTANEOUS_EULER: ReplyLayout((("euler", 3),)),
    CommandByte.STABILIZED_EULER: ReplyLayout((("euler", 3),)),
    # a zero byte and the streamed command; the second word is zero or the ticks, sources differ: not read as ticks
    CommandByte.CONTINUOUS: ReplyLayout((("streamed", 1), ("unsettled", 1)), has_ticks=False),
    CommandByte.READ_EEPROM: ReplyLayout((("value", 1),)),
    CommandByte.EULER_VECTORS: ReplyLayout((("euler", 3), ("acceleration", 3), ("rate", 3))),
    CommandByte.FIRMWARE: ReplyLayout((("version", 1),), has_ticks=False),
    CommandByte.SERIAL: ReplyLayout((("serial", 1),), has_ticks=False),
}

LENGTHS: dict[int, int] = {command: layout.length for command, layout in LAYOUTS.items()}

MEASUREMENTS = frozenset(
    {
        CommandByte.STABILIZED_VECTORS,
        CommandByte.INSTANTANEOUS_VECTORS,
        CommandByte.QUATERNION_VECTORS,
        CommandByte.INSTANTANEOUS_EULER,
        CommandByte.STABILIZED_EULER,
        CommandByte.EULER_VECTORS,
    }
)
"""Measurements: what may be streamed."""

_SLICES = {
    command: {
        name: slice(end - count, end)
        for (name, count), end in zip(layout.fields, accumulate(count for _, count in layout.fields), strict=True)
    }
    for command, layout in LAYOUTS.items()
}
_STRUCTS = {command: struct.Struct(f">{layout.words}h") for command, layout in LAYOUTS.items()}
_UNSIGNED = {command: struct.Struct(f">B{(length - 3) // 2}HH") for command, length in LENGTHS.items()}


class Gx1Packet(NamedTuple):
    """A reply: its command, its words as signed numbers, and the timer's ticks, 0..65535, or None without."""

    command: int
    words: tuple[int, ...]
    ticks: int | None = None

    def field(self, name: str) -> tuple[int, ...]:
        """Return the words of a field of its layout, signed; KeyError for a field that it does not have."""
        return self.words[_SLICES[self.command][name]]

    def has(self, name: str) -> bool:
        """Return whether its layout has the field."""
        return name in _SLICES[self.command]

    @property
    def unsigned(self) -> int:
        """The first word as a number 0..65535: temperature, EEPROM value, version, serial number."""
        return self.words[0] & 0xFFFF

    def to_bytes(self) -> bytes:
        """Encode the reply. Raises ValueError for words that do not match its layout."""
        layout = LAYOUTS[self.command]
        if len(self.words) != layout.words or (self.ticks is None) == layout.has_ticks:
            raise ValueError(f"a reply 0x{self.command:02x} has {layout.words} words, ticks: {layout.has_ticks}")
        words: Sequence[int] = self.words if self.ticks is None else (*self.words, self.ticks)
        return append_checksum(struct.pack(f">B{len(words)}H", self.command, *(word & 0xFFFF for word in words)))


def decode_packet(data: bytes | bytearray, at: int, command: int) -> Gx1Packet | None:
    """Return the reply that begins at `at`, whose first byte is `command`; None if its checksum is wrong.

    The whole reply must be there: `LENGTHS[command]` bytes.
    """
    unsigned = _UNSIGNED[command].unpack_from(data, at)
    if (sum(unsigned) - 2 * unsigned[-1]) & 0xFFFF:
        return None
    words = _STRUCTS[command].unpack_from(data, at + 1)
    return Gx1Packet(command, words, unsigned[-2] if LAYOUTS[command].has_ticks else None)


class EepromAddress:
    """Even addresses of the EEPROM's words."""

    GYRO_GAIN = 130
    ACCELEROMETER_GAIN = 230
    MAGNETOMETER_GAIN = 232
    GAINS = (GYRO_GAIN, ACCELEROMETER_GAIN, MAGNETOMETER_GAIN)
    TIMER = (238, 240, 242, 246)


class Gains(NamedTuple):
    """The gain words of gyros, accelerometers and magnetometers."""

    gyro: int
    accelerometer: int
    magnetometer: int


ReplyValidator = Callable[[Gx1Packet], str]
"""Returns the reason to reject a reply with a valid checksum; empty to accept it."""


class Gx1Parser:
    """Finds the expected replies in a stream of bytes; see the module."""

    def __init__(self, judge: ReplyValidator = lambda _: ""):
        self._validate = judge
        self._buffer = bytearray()
        self._streamed: frozenset[int] = frozenset()
        self._expected: Counter[int] = Counter()
        self._update_pattern()
        self.counts: Counter[str] = Counter()
        """`skipped` bytes outside of replies, and `rejected.<reason>`."""

    def set_streamed(self, *commands: int) -> None:
        """Set the commands whose replies are accepted without a request."""
        self._streamed = frozenset(commands)
        self._update_pattern()

    def expect(self, command: int) -> None:
        """Accept one more reply to a command."""
        self._expected[command] += 1
        self._update_pattern()

    def cancel(self, command: int) -> None:
        """Expect no more replies to a command."""
        self._expected.pop(command, None)
        self._update_pattern()

    def clear(self) -> None:
        """Discard buffered bytes and expectations."""
        self.counts["skipped"] += len(self._buffer)
        self._buffer.clear()
        self._expected.clear()
        self.set_streamed()

    def feed(self, data: bytes) -> list[Gx1Packet]:
        """Return the replies that `data` completes, in order."""
        buffer = self._buffer
        buffer += data
        found: list[Gx1Packet] = []
        at = 0
        while True:
            match = self._start_pattern.search(buffer, at)
            begin = len(buffer) if match is None else match.start()
            self.counts["skipped"] += begin - at
            at = begin
            if match is None:
                break
            command = buffer[at]
            if at + LENGTHS[command] > len(buffer):
                break
            packet = decode_packet(buffer, at, command)
            reason = "checksum" if packet is None else self._validate(packet)
            if packet is None or reason:
                self.counts[f"rejected.{reason}"] += 1
                self.counts["skipped"] += 1
                at += 1
                continue
            at += LENGTHS[command]
            found.append(packet)
            if command not in self._streamed:
                self._expected -= Counter((command,))
                self._update_pattern()
        # a match object locks the buffer against resizing
        del match
        del buffer[:at]
        return found

    def _update_pattern(self) -> None:
        """Match the first byte of a reply; nothing where none is expected."""
        first = re.escape(bytes(sorted(self._streamed | self._expected.keys())))
        self._start_pattern = re.compile(b"[" + first + b"]" if first else b"(?!)")


COUNTER_RANGE = 65536
"""Ticks until the counter wraps."""

SLACK_NS = 500_000_000
"""Tolerance: the previous reply may have been read this much late."""

MIN_TICK_S = 0.005
"""Shortest possible tick, used while its length is unknown."""

MAX_POLL_LAG = 2
"""Ticks by which a polled reply may be behind a streamed one that was sent before it."""

MIN_AGREEING = 3
"""Consecutive replies that agree with each other but not with the previous ones: the counter has jumped."""


class TickUnwrapper:
    """Unwraps ticks and checks their plausibility. Instants are the host's monotonic nanoseconds.

    The unwrapped count starts above zero, goes back by at most `MAX_POLL_LAG`, and advances by more than
    `COUNTER_RANGE` when the counter has jumped or `reset` was called.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._at_ns = 0
        self._candidate: tuple[int, int] = (0, 0)
        self._agreeing_count = 0
        self._count = COUNTER_RANGE
        self._ticks_per_ns = 1e-9 / MIN_TICK_S
        self.has_jumped = False
        """The counter has jumped since `reset`."""

    def set_tick(self, tick_s: float) -> None:
        """Set the length of a tick; the device's clock and the host's may differ by 5 %."""
        self._ticks_per_ns = 1.05e-9 / tick_s

    def reset(self) -> None:
        """Accept any next count: the device may have restarted."""
        self._last = None
        self._agreeing_count = 0
        self._count = (self._count // COUNTER_RANGE + 2) * COUNTER_RANGE
        self.has_jumped = False

    def unwrap(self, ticks: int, at_ns: int, streamed: bool) -> int | None:
        """Return the unwrapped ticks of a reply; None if they are implausible."""
        if self._last is None:
            return self._restart(ticks, at_ns)
        ahead = (ticks - self._last) % COUNTER_RANGE
        if ahead <= self._max_advance(at_ns - self._at_ns):
            self._count += ahead
            self._last, self._at_ns = ticks, at_ns
            self._agreeing_count = 0
            return self._count
        if not streamed and COUNTER_RANGE - ahead <= MAX_POLL_LAG:
            return self._count - (COUNTER_RANGE - ahead)
        return self._on_outlier(ticks, at_ns)

    def _max_advance(self, elapsed_ns: int) -> float:
        return (elapsed_ns + SLACK_NS) * self._ticks_per_ns + 1.0

    def _restart(self, ticks: int, at_ns: int) -> int:
        self._last, self._at_ns, self._agreeing_count = ticks, at_ns, 0
        self._count = self._count // COUNTER_RANGE * COUNTER_RANGE + ticks
        return self._count

    def _on_outlier(self, ticks: int, at_ns: int) -> int | None:
        before, since_ns = self._candidate
        agrees = self._agreeing_count > 0 and (ticks - before) % COUNTER_RANGE <= self._max_advance(at_ns - since_ns)
        self._agreeing_count = self._agreeing_count + 1 if agrees else 1
        self._candidate = (ticks, at_ns)
        if self._agreeing_count < MIN_AGREEING:
            return None
        self.reset()
        self.has_jumped = True
        return self._restart(ticks, at_ns)


LAST_ADDRESS = 254

_FRAMES: dict[int, tuple[bytes, int]] = dict.fromkeys(LAYOUTS, (b"", 0)) | {
    CommandByte.CONTINUOUS: (b"\0", 1),
    CommandByte.READ_EEPROM: (b"", 2),
}
"""Command -> the key between it and its data, and the length of the data."""


class Gx1Request(NamedTuple):
    """A request of the host: the command and its data bytes without keys."""

    command: int
    data: bytes = b""

    def to_bytes(self) -> bytes:
        key, _ = _FRAMES[self.command]
        return bytes((self.command,)) + key + self.data


def make_poll(command: int) -> bytes:
    """Return the request for one reply of a command that takes no data."""
    return Gx1Request(command).to_bytes()


def make_stream(command: int) -> bytes:
    return Gx1Request(CommandByte.CONTINUOUS, bytes((command,))).to_bytes()


STOP = make_stream(0)
"""Stop the continuous mode."""


def make_read_eeprom(address: int) -> bytes:
    """Return the request for a word of the EEPROM, at an even address up to 254."""
    return Gx1Request(CommandByte.READ_EEPROM, _encode_address(address)).to_bytes()


def _encode_address(address: int) -> bytes:
    if not 0 <= address <= LAST_ADDRESS or address % 2:
        raise ValueError(f"an address of the EEPROM is even and 0..{LAST_ADDRESS}, got {address}")
    return address.to_bytes(2, "big")


class RequestParser:
    """Requests out of the bytes that come to a device. What fits no request is skipped, byte by byte."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.skipped = 0

    def feed(self, data: bytes) -> list[Gx1Request]:
        """Return the requests that are complete; at most 2 bytes wait for more."""
        self._buffer += data
        buffer, at, found = self._buffer, 0, []
        while at < len(buffer):
            command = buffer[at]
            key, length = _FRAMES.get(command, (b"", 0))
            begin = at + 1 + len(key)
            after = begin + length
            if after > len(buffer):
                break
            if command in _FRAMES and buffer.startswith(key, at + 1):
                found.append(Gx1Request(command, bytes(buffer[begin:after])))
                at = after
            else:
                at += 1
                self.skipped += 1
        del buffer[:at]
        return found

    def clear(self) -> None:
        self._buffer.clear()


G0 = 9.80665
"""Standard gravity, m/s2: the device's g."""

TESLA = 1e-4
"""A gauss."""

_FULL_SCALE = 32_768_000.0
_ANGLE_SCALE = 2.0 * math.pi / 65536.0
_QUATERNION_SCALE = 1.0 / 8192.0
MIN_WORD, MAX_WORD = -32768, 32767

QUARTER_TURN = 16384
"""A right angle in words of Euler angles."""


def vector_from_words(words: Iterable[int], gain: int, unit: float = 1.0) -> Vector3:
    """Return three words in rad/s, or in `unit` given in SI (G0, TESLA)."""
    factor = gain * unit / _FULL_SCALE
    x, y, z = words
    return so3.scale(factor, (x, y, z))


def vector_to_words(value: Vector3, gain: int, unit: float = 1.0) -> tuple[int, int, int]:
    """Return the words of a vector, saturated where it is too large."""
    x, y, z = so3.scale(_FULL_SCALE / (gain * unit), value)
    return (saturate(x), saturate(y), saturate(z))


def saturate(value: float) -> int:
    """Return the nearest signed 16-bit word."""
    return min(max(round(value), MIN_WORD), MAX_WORD)


def is_saturated(words: Iterable[int]) -> bool:
    """Return whether a word is at an end of its range."""
    return any(word in (MIN_WORD, MAX_WORD) for word in words)


def orientation_from_euler(words: Iterable[int]) -> Quaternion:
    """Return the orientation of the sensor's axes in north, east, down from the words of roll, pitch, yaw."""
    return so3.from_rpy(*(word * _ANGLE_SCALE for word in words))


def euler_to_words(orientation: Quaternion) -> tuple[int, int, int]:
    """Return roll, pitch, yaw as words, each turn within -32768..32767."""
    roll, pitch, yaw = (round(angle / _ANGLE_SCALE) for angle in so3.to_rpy(orientation))
    return (_wrap(roll), pitch, _wrap(yaw))


def _wrap(word: int) -> int:
    return (word + 32768) % 65536 - 32768


def orientation_from_quaternion(words: Iterable[int]) -> Quaternion:
    """Return the orientation of the sensor's axes in north, east, down from four words, scalar first.

    Raises ValueError for four zeros.
    """
    w, x, y, z = (word * _QUATERNION_SCALE for word in words)
    return so3.normalize((w, x, y, z))


def quaternion_to_words(orientation: Quaternion) -> tuple[int, int, int, int]:
    w, x, y, z = (round(element / _QUATERNION_SCALE) for element in orientation)
    return (w, x, y, z)


def is_unit(words: Iterable[int]) -> bool:
    """Return whether four words are a unit quaternion within 1 %."""
    return abs(math.hypot(*words) * _QUATERNION_SCALE - 1.0) < 0.01


def temperature_from_word(word: int) -> float:
    """Return degrees Celsius from an unsigned word."""
    return (word * 5.0 / 65536.0 - 0.5) * 100.0


def temperature_to_word(celsius: float) -> int:
    return min(max(round((celsius / 100.0 + 0.5) * 65536.0 / 5.0), 0), 65535)


def tick_from_timer_words(timer: Iterable[int]) -> float:
    """Return the seconds of a timer tick from the four timer words of the EEPROM: their product times 100 ns.

    Both documented settings agree with it, 16 16 256 1 with 6.5536 ms and 4 10 250 10 with 10 ms; for others it is
    inferred. Zero for a product of zero.
    """
    return math.prod(timer) * 1e-7


DOCUMENTED_TIMERS = frozenset({(16, 16, 256, 1), (4, 10, 250, 10)})
"""Timer words whose tick is documented: the default, and what is known as 100 Hz."""


def format_version(word: int) -> str:
    """Return the firmware's version as people write it."""
    return f"{word // 1000}.{word % 1000 // 100}.{word % 100:02d}"
