"""`modelserver reload`: reload the geometry file of the running daemon."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from modelserver.errors import ForbiddenError, ModelServerError, RejectedError
from modelserver.messages import ReloadReply
from mstools.terminal.options import JsonOption, KeyOption, PrefixOption, TimeoutOption, UrlOption, option
from mstools.terminal.output import escape

PERMISSION_HINT = (
    "or on its machine send SIGHUP to the daemon (kill -HUP PID), which needs no permission; the result is in its log"
)


def command(
    dry_run: Annotated[bool, option("--dry-run", "Only print what would change.")] = False,
    as_json: JsonOption = False,
    url: UrlOption = "",
    prefix: PrefixOption = "",
    timeout: TimeoutOption = 2.0,
    key: KeyOption = None,
) -> None:
    """Reload the geometry file of the running daemon, and print the changes.

    Either the whole file fits the vehicle and is used from now on, or nothing changes and all problems are printed.
    The vehicle file itself is not reloaded: restart the daemon for that. The daemon applies the request if its vehicle
    file has commands: {reload: true, key_file: ...} and the request is signed with that key (--key); kill -HUP on its
    machine needs no permission. Exit code 1 if the geometry is rejected.

    Example: modelserver reload --dry-run
    """
    from modelserver.client.remote import Platform

    with Platform(
        url, channel_prefix=prefix, timeout=timeout, retries=0, name="modelserver", key_file=key or ""
    ) as platform:
        try:
            reply = platform.reload_model(dry_run=dry_run)
        except ForbiddenError as error:
            raise ModelServerError(f"reload denied: {error}; {PERMISSION_HINT}") from None
        except RejectedError as error:
            for line in str(error).splitlines():
                typer.echo(escape(line), err=True)
            stays = "the geometry in force stays" if not dry_run else "the daemon would reject it"
            raise ModelServerError(f"{stays}; run modelserver check for details with line numbers") from None
    typer.echo(json.dumps(as_data(reply, dry_run), indent=2) if as_json else describe(reply, dry_run))


def describe(reply: ReloadReply, dry_run: bool) -> str:
    """Format the result."""
    if not reply.changes:
        return f"nothing {'would change' if dry_run else 'changed'}: revision {escape(reply.revision)}"
    head = "would be" if dry_run else "is now"
    lines = [f"the geometry in force {head} revision {escape(reply.revision)}; changes:"]
    return "\n".join(lines + [f"  {escape(change)}" for change in reply.changes])


def as_data(reply: ReloadReply, dry_run: bool) -> dict[str, object]:
    """Return the result as JSON data."""
    return {
        "dry_run": dry_run,
        "revision": reply.revision,
        "revision_in_force": reply.header.model_revision,
        "changes": list(reply.changes),
    }
