"""The chain of a journal's segments: what proves that they are whole, in their order, and of this vehicle.

The head of each segment holds its number in the ring, the number of the run, its own number in the run, and the seal of
the segment before it. The seal is at the end of a segment: with a key HMAC-SHA256 over a digest of all its bytes, head
included, without one the digest itself. So with the key nobody else can make, change, exchange or reorder segments;
without it the same checks find accidents alone.

The file `newest` names the last segment, so that missing ones at the end are found. It is sealed too, but an old one
that is put back together with fewer segments cannot be told from the truth: nothing on the same disk can.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import mmap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from modelserver.errors import RecordingError
from modelserver.regular_files import open_regular, read_start
from modelserver.service.journal.ring import SEGMENT_NAME, segments
from modelserver.signing import Key
from modelserver.wire.journal import End, Head, read, read_end

SEGMENT_DOMAIN: Final = b"modelserver journal segment, version 1\n"
NEWEST_DOMAIN: Final = b"modelserver journal newest, version 1\n"
"""What the sealed bytes begin with: no other use of a key has the same."""

NEWEST_NAME: Final = "newest"

LONGEST_NEWEST: Final = 1024
"""Bytes of the file."""


def seal_segment(key: Key | None, digest: bytes) -> bytes:
    """Return the MAC of a segment with this SHA-256; empty without a key."""
    return b"" if key is None else hmac.digest(key.secret, SEGMENT_DOMAIN + digest, hashlib.sha256)


class Newest(NamedTuple):
    """The last segment of a journal: number of its run, its number in the ring, its seal (hex; empty: not closed)."""

    run: int
    number: int
    seal: str = ""

    def encode(self, key: Key | None) -> bytes:
        """Return the bytes of the file."""
        line = json.dumps({"key": "" if key is None else key.name, **self._asdict()}).encode() + b"\n"
        return line + _newest_seal(key, line).encode() + b"\n"


def _newest_seal(key: Key | None, line: bytes) -> str:
    data = NEWEST_DOMAIN + line
    return (hashlib.sha256(data) if key is None else hmac.new(key.secret, data, hashlib.sha256)).hexdigest()


def read_newest(directory: Path, keys: Sequence[Key], checks: bool = True) -> Newest | None:
    """Return what the file says; None where there is none.

    `checks`: raise RecordingError where it is damaged or not genuine. The keyed seal is not checked where there are no
    keys at all. Without checks such a file counts as none.
    """
    try:
        data = read_start(directory / NEWEST_NAME, LONGEST_NEWEST)
    except OSError:
        return None
    try:
        return _parse_newest(data, keys)
    except (RecordingError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        if not checks:
            return None
        raise RecordingError(f"the file {NEWEST_NAME} is damaged or not genuine: {error}") from error


def _parse_newest(data: bytes, keys: Sequence[Key]) -> Newest:
    line, _, seal = data.partition(b"\n")
    line += b"\n"
    found = json.loads(line)
    key = _key_named(found["key"], keys)
    if (key is not None or not found["key"]) and not hmac.compare_digest(_newest_seal(key, line).encode(), seal[:-1]):
        raise RecordingError("its seal is wrong")
    newest = Newest(found["run"], found["number"], found["seal"])
    if type(newest.run) is not int or type(newest.number) is not int or type(newest.seal) is not str:
        raise RecordingError("its fields are no numbers")
    return newest


def _key_named(name: str, keys: Sequence[Key]) -> Key | None:
    """Return the key of a name; None where no key is asked for or there are none. Raises RecordingError."""
    if not name or not keys:
        return None
    for key in keys:
        if key.name == name:
            return key
    raise RecordingError(f"it is sealed with key {name[:64]!r}, which is not in the key file")


class LastSegment(NamedTuple):
    """The last segment that a directory holds: the number of its run, -1: there is none; its seal, see `Newest`."""

    run: int = -1
    seal: str = ""


def last_link(directory: Path) -> LastSegment:
    """Return the last segment of a directory, as far as its head and its end can be read. Raises OSError."""
    held = segments(directory)
    if not held:
        return LastSegment()
    with open_regular(held[-1]) as file:
        if not file.seek(0, 2):
            return LastSegment()
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            head, end = next(iter(read(data)), None), read_end(data)
    run = head.facts.get("run_number") if isinstance(head, Head) else None
    return LastSegment(run if type(run) is int else -1, "" if end is None else end.seal.hex())


class ChainFinding(NamedTuple):
    """Something about the chain. `damage`: segments are missing, exchanged, or not genuine."""

    text: str
    damage: bool = True


class _Link(NamedTuple):
    path: Path
    number: int
    seal: str
    """Hexadecimal; empty: the segment is not closed."""


class Chain:
    """Checks segments in the order in which they are given. `genuine` counts those whose keyed seal is right."""

    def __init__(self, keys: Sequence[Key] = ()):
        self.genuine = 0
        self.unsealed: list[Path] = []
        """Segments whose seal proves nothing: not closed, without a key, or no key to check it is given."""
        self._keys = keys
        self._before: _Link | None = None
        self._places: dict[int, Path] = {}

    def begin(self, path: Path, facts: dict[str, Any]) -> list[ChainFinding]:
        """Check where a segment belongs, by its head."""
        found = []
        number, previous = facts["number"], str(facts["previous"])
        match = SEGMENT_NAME.fullmatch(path.name)
        if match is not None and int(match[1]) != number:
            found.append(ChainFinding(f"is segment {number} by its own head: renamed, or put in the place of another"))
        first = self._places.setdefault(number, path)
        before = self._before
        if first != path:
            found.append(ChainFinding(f"occurs twice: it is {first.name} once more"))
        elif before is None:
            if number > 0 or previous:
                count = f"{number} earlier segments" if number > 0 else "earlier segments"
                found.append(ChainFinding(f"{count} were dropped by the ring, or removed", damage=False))
        elif number <= before.number:
            found.append(ChainFinding(f"is older than {before.path.name} before it: the order was changed"))
        elif number > before.number + 1:
            missing = number - before.number - 1
            found.append(
                ChainFinding(f"{missing} segments before it are missing, behind {before.path.name}: removed, or lost")
            )
        elif previous and not before.seal:
            found.append(ChainFinding(f"goes on from {before.path.name}, whose end was cut off after it was written"))
        elif previous != before.seal:
            found.append(ChainFinding(f"does not follow from {before.path.name}: one of the two was exchanged"))
        self._before = _Link(path, number, "")
        return found

    def end(self, facts: dict[str, Any], end: End | None) -> list[ChainFinding]:
        """Check the seal of the segment that was begun last; `end` None: it is not closed."""
        before = self._before
        assert before is not None
        name = str(facts["key"])
        if end is None:
            self.unsealed.append(before.path)
            return []
        self._before = before._replace(seal=end.seal.hex())
        if not name or not self._keys:
            self.unsealed.append(before.path)
            if name or not end.mac:
                return []
        try:
            key = _key_named(name, self._keys)
        except RecordingError as error:
            return [ChainFinding(f"cannot be proved: {error}")]
        if not hmac.compare_digest(seal_segment(key, end.digest), end.mac):
            return [ChainFinding("its seal is wrong: it was not written by who knows the key")]
        self.genuine += key is not None
        return []

    def skip(self, path: Path) -> None:
        """Take note of a segment whose head cannot be read, and so is not closed."""
        match = SEGMENT_NAME.fullmatch(path.name)
        self.unsealed.append(path)
        if self._before is not None and match is not None:
            self._before = _Link(path, int(match[1]), "")

    def finish(self, newest: Newest | None) -> list[ChainFinding]:
        """Check that the last segment is the one that `newest` names; None: it is not known."""
        before = self._before
        if newest is None or before is None:
            return []
        if newest.number > before.number:
            count = newest.number - before.number
            return [ChainFinding(f"{count} segments after {before.path.name} are missing at the end: removed, or lost")]
        if newest.number < before.number:
            # the machine may stop between making a segment and naming it
            if newest.number == before.number - 1 and not before.seal:
                return []
            return [ChainFinding(f"the file {NEWEST_NAME} is older than {before.path.name}: it was put back")]
        if newest.seal and newest.seal != before.seal:
            why = "was exchanged" if before.seal else "was cut off after it was closed"
            return [ChainFinding(f"{before.path.name}, the last segment, {why}")]
        return []
