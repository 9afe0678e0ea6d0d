"""`modelserver replay --verify`: a journal is run again, and all that was said is compared."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mstools.output import counted, safe
from mstools.progress import progress

if TYPE_CHECKING:
    from modelserver.service.journal.verify import Difference, Verified

MOST_FIELDS = 12
"""Fields of a message that are printed where they differ."""

MOST_REMARKS = 20


def verified(journal: Path, as_json: bool) -> None:
    """Verify a journal and print what was found; exit code 1 where that is no proof."""
    # as the daemon does: the sums of the linear algebra come in another order with more threads
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from modelserver.service.journal.files import files_of
    from modelserver.service.journal.verify import verify

    files = files_of(journal)
    with progress(f"verifying {journal.name}", sum(path.stat().st_size for path in files)) as show:
        found = verify(files, show)
    if as_json:
        typer.echo(json.dumps(_as_json(found)))
    else:
        for line in lines(found):
            typer.echo(safe(line))
        for remark in found.remarks[:MOST_REMARKS]:
            typer.echo(safe(f"modelserver: {remark}"), err=True)
        if len(found.remarks) > MOST_REMARKS:
            typer.echo(f"modelserver: {len(found.remarks) - MOST_REMARKS} remarks more (--json has all)", err=True)
        if found.other:
            typer.echo(safe(f"modelserver: bits may differ: {'; '.join(found.other)}"), err=True)
    if not found.proved:
        raise typer.Exit(1)


def lines(found: Verified) -> list[str]:
    """Return what was found, in words."""
    span = (found.last_utime - found.first_utime) * 1e-6
    where = f"{counted(found.segments, 'segment')} of {counted(found.runs, 'run')}, {found.seconds:.1f} of {span:.1f} s"
    told = [f"{where} ({_when(found.first_utime)} to {_when(found.last_utime)}), {found.handled} records run again"]
    said = sum(found.said.values())
    if said:
        told.append(f"{found.poses} poses and {said - found.poses} other messages are reproduced bit for bit:")
        told += [f"  {name:24} {count:9}" for name, count in sorted(found.said.items())]
    else:
        told.append("nothing is reproduced: nothing in it was said, or it is not known what to begin from")
    if found.skipped:
        told.append(
            f"not verified: {counted(sum(found.skipped.values()), 'message')}, for what the service knew then is not "
            "in the journal"
        )
    if found.old:
        told.append(
            f"not verified: {found.old} replies about the past, from before the first segment that is still held"
        )
    if found.difference is not None:
        told += _difference(found.difference)
    return told


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
    """Return the fields of two messages that differ: name, and what either says. Where one cannot be read, its length.

    Numbers are shown with all digits that tell them apart.
    """
    import mslcm

    kinds: dict[bytes, Any] = {
        kind._get_packed_fingerprint(): kind
        for kind in vars(mslcm).values()
        if isinstance(kind, type) and hasattr(kind, "_get_packed_fingerprint")
    }
    kind = kinds.get(was[:8])
    if kind is None or was[:8] != now[:8]:
        return [("type or content", f"{len(was)} bytes {was[:12].hex()}", f"{len(now)} bytes {now[:12].hex()}")]
    try:
        fields = list(_fields("", kind.decode(was), kind.decode(now)))
    except Exception as error:
        return [("content", f"{len(was)} bytes", f"{len(now)} bytes that cannot be read ({error})")]
    return fields or [("bits", "nan or zero", "another nan or zero")]


def _fields(name: str, was: Any, now: Any) -> list[tuple[str, str, str]]:
    if hasattr(was, "_get_packed_fingerprint") and type(was) is type(now):
        found = []
        for slot in was.__slots__:
            found += _fields(f"{name}.{slot}" if name else slot, getattr(was, slot), getattr(now, slot))
        return found
    if isinstance(was, (list, tuple)) and isinstance(now, (list, tuple)):
        if len(was) != len(now):
            return [(name, f"{len(was)} of them", f"{len(now)} of them")]
        return [each for n, pair in enumerate(zip(was, now, strict=True)) for each in _fields(f"{name}[{n}]", *pair)]
    return [] if repr(was) == repr(now) else [(name, repr(was), repr(now))]


def _as_json(found: Verified) -> dict[str, Any]:
    first = found.difference
    return {
        "proved": found.proved,
        "segments": found.segments,
        "runs": found.runs,
        "seconds": found.seconds,
        "span": (found.last_utime - found.first_utime) * 1e-6,
        "records": found.handled,
        "poses": found.poses,
        "said": dict(sorted(found.said.items())),
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
