"""`modelserver replay --verify`: replay a journal, and compare all published messages bit for bit."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mstools.terminal.output import escape, format_count
from mstools.terminal.progress import show_progress

if TYPE_CHECKING:
    from modelserver.server.journal.verify import Difference, VerificationReport

MAX_FIELDS = 12
"""Printed differing fields of a message."""

MAX_FINDINGS = 20


def run_verification(journal: Path, as_json: bool, key: Path | None = None) -> None:
    """Verify a journal and print the result; the exit code is the `VerificationResult`.

    `key`: the vehicle's key file. Without one authenticity is not verified, and a journal that is reproduced bit for
    bit exits with 0.
    """
    from modelserver.key_files import read_keys
    from modelserver.server.journal.segments import files_of
    from modelserver.server.journal.verify import VerificationResult, verify

    keys = () if key is None else read_keys(key)
    files = files_of(journal)
    with show_progress(f"verifying {journal.name}", sum(path.stat().st_size for path in files)) as show:
        found = verify(files, show, keys, journal if journal.is_dir() else None)
    if as_json:
        typer.echo(json.dumps(_as_json(found)))
    else:
        for line in format_result(found, bool(keys)):
            typer.echo(escape(line))
        for finding in found.findings[:MAX_FINDINGS]:
            typer.echo(escape(f"modelserver: {finding}"), err=True)
        if len(found.findings) > MAX_FINDINGS:
            typer.echo(f"modelserver: {len(found.findings) - MAX_FINDINGS} more findings (--json has all)", err=True)
        if found.environment_differences:
            typer.echo(escape(f"modelserver: bits may differ: {'; '.join(found.environment_differences)}"), err=True)
    if found.result is not VerificationResult.REPRODUCED or keys:
        raise typer.Exit(found.result)


def format_result(found: VerificationReport, keyed: bool = False) -> list[str]:
    """Format the result; `keyed`: whether it was verified with a key."""
    from modelserver.server.journal.comparison import TOLERANCE

    span = (found.last_utime - found.first_utime) * 1e-6
    text = [
        f"{format_count(found.segments, 'segment')} of {format_count(found.runs, 'run')}, {found.seconds:.1f} of "
        f"{span:.1f} s ({_format_time(found.first_utime)} to {_format_time(found.last_utime)}), {found.handled} "
        "records replayed"
    ]
    exact, close = sum(found.reproduced.values()), sum(found.within_tolerance.values())
    poses, same = found.reproduced_poses, f"the same within {TOLERANCE:g} m and rad: {_format_largest(found)}"
    for counts, what in (
        (found.reproduced, f"{poses} poses and {exact - poses} other messages are reproduced bit for bit"),
        (found.within_tolerance, f"{format_count(close, 'message')} are {same}"),
    ):
        if any(counts.values()):
            text += [f"{what}:", *(f"  {name:24} {count:9}" for name, count in sorted(counts.items()))]
    if not exact and not close:
        text.append("nothing is reproduced: it has no sent messages, or no state to start from")
    if found.skipped:
        skipped = format_count(sum(found.skipped.values()), "message")
        text.append(f"not verified: {skipped}, which depend on a state before the journal")
    if found.unverifiable:
        text.append(f"not verified: {found.unverifiable} replies about times before the first remaining segment")
    if found.difference is not None:
        text += _format_difference(found.difference)
    text.append(_format_verdict(found, keyed))
    return text


def _format_largest(found: VerificationReport) -> str:
    off, (meters, radians) = found.max_deviation, found.max_deviation_channels
    return (
        f"largest difference {off.meters:.2g} m{f' in {meters}' if meters else ''}, "
        f"{off.radians:.2g} rad{f' in {radians}' if radians else ''}, {off.share:.2g} of any other number"
    )


def _format_verdict(found: VerificationReport, keyed: bool) -> str:
    if not found.is_reproduced:
        return "NOT PROVED: see the problems above"
    words = "reproduced, but not all of it bit for bit" if found.within_tolerance else "reproduced bit for bit"
    if found.is_authentic:
        return f"authentic: {words}, sealed with the vehicle's key"
    if not keyed:
        return f"{words}; not proved authentic (--key FILE checks the seals, where the vehicle has a key file)"
    why = "segments may be missing at the end"
    if found.unsealed:
        why = f"{format_count(found.unsealed, 'segment')} of {found.segments} not closed, or not sealed with a key"
    return f"{words}; not proved authentic: {why}"


def _format_time(utime: int) -> str:
    return datetime.fromtimestamp(utime * 1e-6, UTC).strftime("%Y-%m-%d %H:%M:%S") if utime else "-"


def _format_difference(first: Difference) -> list[str]:
    place = f"{first.segment} at byte {first.at}, utime {first.utime} ({_format_time(first.utime)})"
    head = f"NOT REPRODUCED: a message on {first.channel}"
    if first.replayed is None:
        return [f"{head} was published, and is not published now: {place}"]
    if first.recorded is None:
        return [f"{head} is published now, and was not published then: {place}"]
    text = [f"NOT REPRODUCED: {first.channel} differs: {place}"]
    fields = find_differences(first.recorded, first.replayed)
    text += [f"  {name}: was {was}, is {now}" for name, was, now in fields[:MAX_FIELDS]]
    if len(fields) > MAX_FIELDS:
        text.append(f"  and {len(fields) - MAX_FIELDS} more fields")
    return text


def find_differences(was: bytes, now: bytes) -> list[tuple[str, str, str]]:
    """Return name and both values of the fields that differ; for a message that cannot be decoded its length."""
    from modelserver.server.journal.comparison import diff_messages

    found = diff_messages(was, now)
    if found is None:
        return [("type or content", f"{len(was)} bytes {was[:12].hex()}", f"{len(now)} bytes {now[:12].hex()}")]
    return [(each.name, _format_value(each.recorded), _format_value(each.replayed)) for each in found] or [
        ("bits", "nan or zero", "another nan or zero")
    ]


def _format_value(value: Any) -> str:
    return f"{len(value)} items" if isinstance(value, (list, tuple)) else repr(value)


def _as_json(found: VerificationReport) -> dict[str, Any]:
    first, fields = found.difference, []
    if first is not None and first.recorded is not None and first.replayed is not None:
        fields = find_differences(first.recorded, first.replayed)
    return {
        "result": found.result.name.lower(),
        "proved": found.is_reproduced,
        "authentic": found.is_authentic,
        "genuine_segments": found.genuine,
        "segments": found.segments,
        "runs": found.runs,
        "seconds": found.seconds,
        "span": (found.last_utime - found.first_utime) * 1e-6,
        "records": found.handled,
        "poses": found.reproduced_poses,
        "exact": dict(sorted(found.reproduced.items())),
        "close": dict(sorted(found.within_tolerance.items())),
        "largest": {name: getattr(found.max_deviation, name) for name in ("meters", "radians", "share")},
        "skipped": sum(found.skipped.values()),
        "old_replies": found.unverifiable,
        "lost": found.lost,
        "findings": [{"segment": str(e.segment), "text": e.text, "damage": e.is_damage} for e in found.findings],
        "other": found.environment_differences,
        "difference": first
        and {
            "segment": str(first.segment),
            "byte": first.at,
            "utime": first.utime,
            "channel": first.channel,
            "fields": [{"field": name, "was": was, "is": now} for name, was, now in fields],
        },
    }
