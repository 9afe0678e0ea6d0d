"""`modelserver replay --verify`: a journal is run again, and all that was said is compared."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mstools.terminal.output import counted, safe
from mstools.terminal.progress import progress

if TYPE_CHECKING:
    from modelserver.service.journal.verify import Difference, Verified

MOST_FIELDS = 12
"""Fields of a message that are printed where they differ."""

MOST_REMARKS = 20


def verified(journal: Path, as_json: bool, key: Path | None = None) -> None:
    """Verify a journal and print what was found; the exit code is the `VerificationResult`.

    `key`: the vehicle's key file. Without one nobody asks for proof that the journal is authentic, and what is
    reproduced bit for bit ends with 0.
    """
    # as the daemon does: the sums of the linear algebra come in another order with more threads
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from modelserver.keys import read_keys
    from modelserver.service.journal.files import files_of
    from modelserver.service.journal.verify import VerificationResult, verify

    keys = () if key is None else read_keys(key)
    files = files_of(journal)
    with progress(f"verifying {journal.name}", sum(path.stat().st_size for path in files)) as show:
        found = verify(files, show, keys, journal if journal.is_dir() else None)
    if as_json:
        typer.echo(json.dumps(_as_json(found)))
    else:
        for line in lines(found, bool(keys)):
            typer.echo(safe(line))
        for remark in found.remarks[:MOST_REMARKS]:
            typer.echo(safe(f"modelserver: {remark}"), err=True)
        if len(found.remarks) > MOST_REMARKS:
            typer.echo(f"modelserver: {len(found.remarks) - MOST_REMARKS} remarks more (--json has all)", err=True)
        if found.other:
            typer.echo(safe(f"modelserver: bits may differ: {'; '.join(found.other)}"), err=True)
    is_done = found.result is VerificationResult.AUTHENTIC or (
        found.result is VerificationResult.REPRODUCED and not keys
    )
    if not is_done:
        raise typer.Exit(found.result)


def lines(found: Verified, keyed: bool = False) -> list[str]:
    """Return what was found, in words; `keyed`: whether it was verified with a key."""
    from modelserver.service.journal.comparison import TOLERANCE

    span = (found.last_utime - found.first_utime) * 1e-6
    where = f"{counted(found.segments, 'segment')} of {counted(found.runs, 'run')}, {found.seconds:.1f} of {span:.1f} s"
    text = [f"{where} ({_when(found.first_utime)} to {_when(found.last_utime)}), {found.handled} records run again"]
    exact, close = sum(found.said.values()), sum(found.close.values())
    if exact:
        text.append(f"{found.poses} poses and {exact - found.poses} other messages are reproduced bit for bit:")
        text += [f"  {name:24} {count:9}" for name, count in sorted(found.said.items())]
    if close:
        text.append(f"{counted(close, 'message')} are the same to within {TOLERANCE:g} m and rad: {_largest(found)}:")
        text += [f"  {name:24} {count:9}" for name, count in sorted(found.close.items())]
    if not exact and not close:
        text.append("nothing is reproduced: nothing in it was sent, or it is not known what to begin from")
    if found.skipped:
        text.append(
            f"not verified: {counted(sum(found.skipped.values()), 'message')}, for what the service knew then is not "
            "in the journal"
        )
    if found.old:
        text.append(
            f"not verified: {found.old} replies about the past, from before the first segment that is still held"
        )
    if found.difference is not None:
        text += _difference(found.difference)
    text.append(_verdict(found, keyed))
    return text


def _largest(found: Verified) -> str:
    off, (meters, radians) = found.largest, found.largest_at
    return (
        f"largest difference {off.meters:.2g} m{f' in {meters}' if meters else ''}, "
        f"{off.radians:.2g} rad{f' in {radians}' if radians else ''}, {off.share:.2g} of any other number"
    )


def _verdict(found: Verified, keyed: bool) -> str:
    if not found.proved:
        return "NOT PROVED: what is wrong is named here"
    words = "reproduced, but not all of it bit for bit" if found.close else "reproduced bit for bit"
    if found.authentic:
        return f"authentic: {words}, sealed with the vehicle's key"
    if not keyed:
        return f"{words}; not proved authentic (--key FILE checks the seals, where the vehicle has a key file)"
    why = "segments may be missing at the end"
    if found.unsealed:
        why = f"{counted(found.unsealed, 'segment')} of {found.segments} not closed, or not sealed with a key"
    return f"{words}; not proved authentic: {why}"


def _when(utime: int) -> str:
    return datetime.fromtimestamp(utime * 1e-6, UTC).strftime("%Y-%m-%d %H:%M:%S") if utime else "-"


def _difference(first: Difference) -> list[str]:
    place = f"{first.segment} at byte {first.at}, utime {first.utime} ({_when(first.utime)})"
    if first.now is None:
        return [f"NOT REPRODUCED: a message on {first.channel} was said, and is not said now: {place}"]
    if first.was is None:
        return [f"NOT REPRODUCED: a message on {first.channel} is said now, and was not then: {place}"]
    told = [f"NOT REPRODUCED: {first.channel} differs: {place}"]
    fields = differing(first.was, first.now)
    told += [f"  {name}: was {was}, is {now}" for name, was, now in fields[:MOST_FIELDS]]
    if len(fields) > MOST_FIELDS:
        told.append(f"  and {len(fields) - MOST_FIELDS} fields more")
    return told


def differing(was: bytes, now: bytes) -> list[tuple[str, str, str]]:
    """Return the fields of two messages that differ: name, and both values. Where one cannot be read, its length.

    Numbers are shown with all digits that tell them apart.
    """
    from modelserver.service.journal.comparison import changes

    found = changes(was, now)
    if found is None:
        return [("type or content", f"{len(was)} bytes {was[:12].hex()}", f"{len(now)} bytes {now[:12].hex()}")]
    return [(each.name, _shown(each.was), _shown(each.now)) for each in found] or [
        ("bits", "nan or zero", "another nan or zero")
    ]


def _shown(value: Any) -> str:
    return f"{len(value)} of them" if isinstance(value, (list, tuple)) else repr(value)


def _as_json(found: Verified) -> dict[str, Any]:
    first = found.difference
    return {
        "result": found.result.name.lower(),
        "proved": found.proved,
        "authentic": found.authentic,
        "genuine_segments": found.genuine,
        "segments": found.segments,
        "runs": found.runs,
        "seconds": found.seconds,
        "span": (found.last_utime - found.first_utime) * 1e-6,
        "records": found.handled,
        "poses": found.poses,
        "said": dict(sorted(found.said.items())),
        "close": dict(sorted(found.close.items())),
        "largest": {"meters": found.largest.meters, "radians": found.largest.radians, "share": found.largest.share},
        "skipped": sum(found.skipped.values()),
        "old_replies": found.old,
        "lost": found.lost,
        "remarks": [{"segment": str(e.segment), "text": e.text, "damage": e.damage} for e in found.remarks],
        "other": found.other,
        "difference": None
        if first is None
        else {
            "segment": str(first.segment),
            "byte": first.at,
            "utime": first.utime,
            "channel": first.channel,
            "fields": []
            if first.was is None or first.now is None
            else [{"field": name, "was": was, "is": now} for name, was, now in differing(first.was, first.now)],
        },
    }
