"""Chain of sealed segments: proves that a journal is complete, in order, and from this vehicle.

The head of each segment holds its number in the ring, the number of the run, its part number in the run, and the seal
of the previous segment. A segment ends with its seal: with a key the HMAC-SHA256 of the digest of all its bytes
including the head, without one the digest itself. So nobody without the key can forge, change, replace or reorder
segments; without a key the checks find accidental damage only.

The sealed file `newest` names the last segment, which detects missing segments at the end. Limit: an older `newest`
restored together with fewer segments cannot be detected by anything on the same disk.
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
from modelserver.files.regular import open_regular, read_start
from modelserver.server.journal.segments import SEGMENT_NAME, list_segments
from modelserver.signing.signatures import Key
from modelserver.wire.journal import SegmentEnd, SegmentHead, read_end, read_segment

SEGMENT_DOMAIN: Final = b"modelserver journal segment, version 1\n"
NEWEST_DOMAIN: Final = b"modelserver journal newest, version 1\n"
"""Domain separation: prefix of the sealed bytes, which no other use of a key shares."""

NEWEST_NAME: Final = "newest"

MAX_NEWEST_BYTES: Final = 1024
"""Bytes of the file."""


def seal_segment(key: Key | None, digest: bytes) -> bytes:
    """Return the MAC of a segment with this SHA-256 digest; empty without a key."""
    return b"" if key is None else hmac.digest(key.secret, SEGMENT_DOMAIN + digest, hashlib.sha256)


class NewestMarker(NamedTuple):
    """Content of the file `newest`: run, number in the ring, and seal of the last segment (hex; empty = not closed)."""

    run: int
    number: int
    seal: str = ""

    def encode(self, key: Key | None) -> bytes:
        """Encode the file with its seal."""
        line = json.dumps({"key": "" if key is None else key.name, **self._asdict()}).encode() + b"\n"
        return line + _seal_newest(key, line).encode() + b"\n"


def _seal_newest(key: Key | None, line: bytes) -> str:
    data = NEWEST_DOMAIN + line
    return (hashlib.sha256(data) if key is None else hmac.new(key.secret, data, hashlib.sha256)).hexdigest()


def read_newest(directory: Path, keys: Sequence[Key], verify: bool = True) -> NewestMarker | None:
    """Return the marker of a journal; None where there is no file.

    With `verify`, raise RecordingError where it is damaged or not authentic; else such a file counts as missing. The
    seal of a key is not checked if `keys` is empty.
    """
    try:
        data = read_start(directory / NEWEST_NAME, MAX_NEWEST_BYTES)
    except OSError:
        return None
    try:
        return _parse_newest(data, keys)
    except (RecordingError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        if not verify:
            return None
        raise RecordingError(f"the file {NEWEST_NAME} is damaged or not authentic: {error}") from error


def _parse_newest(data: bytes, keys: Sequence[Key]) -> NewestMarker:
    line, _, seal = data.partition(b"\n")
    line += b"\n"
    found = json.loads(line)
    key = _find_key(found["key"], keys)
    if (key is not None or not found["key"]) and not hmac.compare_digest(_seal_newest(key, line).encode(), seal[:-1]):
        raise RecordingError("its seal is wrong")
    newest = NewestMarker(found["run"], found["number"], found["seal"])
    if type(newest.run) is not int or type(newest.number) is not int or type(newest.seal) is not str:
        raise RecordingError("its fields have wrong types")
    return newest


def _find_key(name: str, keys: Sequence[Key]) -> Key | None:
    """Return the named key; None where the journal has no key or no keys are given. Raises RecordingError."""
    if not name or not keys:
        return None
    for key in keys:
        if key.name == name:
            return key
    raise RecordingError(f"it is sealed with key {name[:64]!r}, which is not in the key file")


class LastSegment(NamedTuple):
    """Last segment in a directory: run number (-1 = there is none) and seal; see `NewestMarker`."""

    run: int = -1
    seal: str = ""


def read_last_segment(directory: Path) -> LastSegment:
    """Return the last segment of a directory, as far as its head and end are readable. Raises OSError."""
    held = list_segments(directory)
    if not held:
        return LastSegment()
    with open_regular(held[-1]) as file:
        if not file.seek(0, 2):
            return LastSegment()
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            head, end = next(iter(read_segment(data)), None), read_end(data)
    run = head.facts.get("run_number") if isinstance(head, SegmentHead) else None
    return LastSegment(run if type(run) is int else -1, "" if end is None else end.seal.hex())


class ChainFinding(NamedTuple):
    """A finding about the chain. `is_damage`: segments are missing, replaced, or not authentic."""

    text: str
    is_damage: bool = True


class _Link(NamedTuple):
    path: Path
    number: int
    seal: str
    """Hexadecimal; empty = the segment is not closed."""


class ChainVerifier:
    """Verifies segments in the given order. `genuine` counts those with a valid keyed seal."""

    def __init__(self, keys: Sequence[Key] = ()):
        self.genuine = 0
        self.unsealed: list[Path] = []
        """Segments without a verifiable seal: not closed, without a key, or the key is not given."""
        self._keys = keys
        self._before: _Link | None = None
        self._places: dict[int, Path] = {}

    def begin(self, path: Path, facts: dict[str, Any]) -> list[ChainFinding]:
        """Check the position of a segment in the chain, by its head."""
        found = []
        number, previous = facts["number"], str(facts["previous"])
        match = SEGMENT_NAME.fullmatch(path.name)
        if match is not None and int(match[1]) != number:
            found.append(ChainFinding(f"is segment {number} by its own head: renamed, or put in place of another"))
        first = self._places.setdefault(number, path)
        before = self._before
        if first != path:
            found.append(ChainFinding(f"is a copy of {first.name}"))
        elif before is None:
            if number > 0 or previous:
                count = f"{number} earlier segments" if number > 0 else "earlier segments"
                found.append(ChainFinding(f"{count} were dropped by the ring, or removed", is_damage=False))
        elif number <= before.number:
            found.append(ChainFinding(f"is older than {before.path.name} before it: out of order"))
        elif number > before.number + 1:
            missing = number - before.number - 1
            found.append(
                ChainFinding(f"{missing} segments before it are missing, after {before.path.name}: removed, or lost")
            )
        elif previous and not before.seal:
            found.append(ChainFinding(f"follows {before.path.name}, whose end was cut off after it was written"))
        elif previous != before.seal:
            found.append(ChainFinding(f"does not match {before.path.name} before it: one of the two was replaced"))
        self._before = _Link(path, number, "")
        return found

    def end(self, facts: dict[str, Any], end: SegmentEnd | None) -> list[ChainFinding]:
        """Check the seal of the current segment; `end` None: it is not closed."""
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
            key = _find_key(name, self._keys)
        except RecordingError as error:
            return [ChainFinding(f"cannot be verified: {error}")]
        if not hmac.compare_digest(seal_segment(key, end.digest), end.mac):
            return [ChainFinding("its seal is wrong: it was not written with the key")]
        self.genuine += key is not None
        return []

    def skip(self, path: Path) -> None:
        """Skip a segment with an unreadable head, which counts as not closed."""
        match = SEGMENT_NAME.fullmatch(path.name)
        self.unsealed.append(path)
        if self._before is not None and match is not None:
            self._before = _Link(path, int(match[1]), "")

    def finish(self, newest: NewestMarker | None) -> list[ChainFinding]:
        """Check that the last segment is the one in `newest`; None: not known."""
        before = self._before
        if newest is None or before is None:
            return []
        if newest.number > before.number:
            count = newest.number - before.number
            return [ChainFinding(f"{count} segments after {before.path.name} are missing at the end: removed, or lost")]
        if newest.number < before.number:
            # a stop between creating a segment and updating the marker is normal
            if newest.number == before.number - 1 and not before.seal:
                return []
            return [ChainFinding(f"the file {NEWEST_NAME} is older than {before.path.name}: restored")]
        if newest.seal and newest.seal != before.seal:
            why = "was replaced" if before.seal else "was cut off after it was closed"
            return [ChainFinding(f"{before.path.name}, the last segment, {why}")]
        return []
