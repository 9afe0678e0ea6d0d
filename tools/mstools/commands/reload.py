"""`modelserver reload`: has the running daemon read its geometry file anew."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from modelserver.errors import ForbiddenError, ModelServerError, RejectedError
from modelserver.messages import ReloadReply
from mstools.commands.asking import JsonOption, KeyOption, PrefixOption, TimeoutOption, UrlOption
from mstools.terminal.output import safe

PERMIT = (
    "or do it on its own machine: kill -HUP with the daemon's process number (needs no permission; the daemon's log "
    "says what came of it)"
)


def command(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would change.")] = False,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 10.0,
    key: KeyOption = None,
) -> None:
    """Have the running daemon read its geometry file anew, and say what changes.

    All of the file suits the vehicle and counts from now on, or nothing changes and every reason is told. The vehicle
    file itself is not read anew: start the daemon anew for that. The daemon obeys where its vehicle file says commands:
    {reload: true, key_file: ...} and the wish is signed with that key (--key); kill -HUP on its own machine needs no
    permission. Exits 1 where the geometry is not taken.

    Example: modelserver reload --dry-run
    """
    from modelserver.client.remote import Platform

    with Platform(
        url, channel_prefix=prefix, timeout=timeout, retries=0, name="modelserver", key_file=key or ""
    ) as platform:
        try:
            reply = platform.reload_model(dry_run=dry_run)
        except ForbiddenError as error:
            raise ModelServerError(f"the daemon does not reload: {error}; {PERMIT}") from None
        except RejectedError as error:
            for line in str(error).splitlines():
                typer.echo(safe(line), err=True)
            stays = "the geometry in force stays" if not dry_run else "the daemon would not take it"
            raise ModelServerError(f"{stays}; modelserver check says more, with lines") from None
    typer.echo(json.dumps(as_data(reply, dry_run), indent=2) if as_json else describe(reply, dry_run))


def describe(reply: ReloadReply, dry_run: bool) -> str:
    """Return what came of it for people to read."""
    if not reply.changes:
        return f"nothing {'would change' if dry_run else 'changed'}: revision {safe(reply.revision)}"
    head = "would be" if dry_run else "is now"
    lines = [f"the geometry in force {head} revision {safe(reply.revision)}; what changes:"]
    return "\n".join(lines + [f"  {safe(change)}" for change in reply.changes])


def as_data(reply: ReloadReply, dry_run: bool) -> dict[str, object]:
    """Return what came of it for scripts to read."""
    return {
        "dry_run": dry_run,
        "revision": reply.revision,
        "revision_in_force": reply.header.model_revision,
        "changes": list(reply.changes),
    }
