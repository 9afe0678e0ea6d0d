"""`modelserver mode`: switch the localization mode of the running daemon."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modelserver.errors import Location, ModelServerError, NoServerError
from modelserver.key_files import KEY_FILE_VARIABLE
from modelserver.messages import Health, Mode, NavigationState, PublishDecisions, SensorHeader, SwitchMode
from modelserver.wire.channels import SIGNED
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.commands.listener import DaemonListener
from mstools.terminal.options import KeyOption, UrlOption, argument, choose_name, option
from mstools.terminal.problems import make_error

if TYPE_CHECKING:
    import lcm

MODES = tuple(mode.name.lower() for mode in Mode)

TIMEOUT_S = 2.0
"""Timeout for the daemon, seconds."""

OPERATOR = "operator"
"""Source of the mode command."""


def command(
    mode: Annotated[str, argument("MODE", f"One of {', '.join(MODES)}.")],
    config: Annotated[Path, option("--config -c FILE", "The vehicle file.")],
    url: UrlOption = "",
    key: KeyOption = None,
) -> None:
    """Switch which sources the localization of the running daemon uses, and report the mode in force.

    The command is sent once, signed, for the channel in the vehicle file (localization.mode_channel), with which the
    daemon must have been started. The key is that of --key, else of $MODELSERVER_KEY_FILE, else of the vehicle file
    (commands.key_file). LOCALIZATION_STATE and LOCALIZATION_DECISIONS confirm the mode within two seconds. Exit code 1
    if no daemon answers, or the mode does not change.

    Example: modelserver mode no_gps -c config/husky/vehicle.yaml
    """
    wanted = parse_mode(mode)
    from modelserver.client.remote import load_signer
    from modelserver.config.vehicle_file import load_config
    from modelserver.wire.codec import encode

    vehicle = load_config(config)
    if not vehicle.localization.mode_channel:
        why = "no channel for mode commands is configured, so the daemon receives none"
        fix = "write mode_channel: LOCALIZATION_MODE under localization, and restart the daemon"
        raise make_error(why, Location(str(config), element="localization.mode_channel"), fix)
    prefix, state_hz = vehicle.lcm.channel_prefix, vehicle.publish.state_hz
    channel = f"{prefix}{vehicle.localization.mode_channel}"
    given = str(key or "") or os.environ.get(KEY_FILE_VARIABLE, "") or vehicle.commands.key_file
    signing = load_signer(given, prefix, "modelserver")
    if signing is None:
        raise ModelServerError(f"the command must be signed; give the daemon's key with --key or ${KEY_FILE_VARIABLE}")
    provider = resolve_url(url or vehicle.lcm.url)
    bus = open_lcm(provider)
    listener = ModeListener(bus, prefix, vehicle.localization.mode_channel)
    if state_hz:
        listener.listen(min(TIMEOUT_S, 2.5 / state_hz), lambda: listener.mode is not None)
    was = listener.mode
    utime = time.time_ns() // 1000
    listener.reset(utime)
    command = encode(SwitchMode(SensorHeader(utime, OPERATOR, host_utime=utime), wanted))
    bus.publish(signing.channel, signing.seal(vehicle.localization.mode_channel, command))
    sent = f"sent {channel}: {wanted.name.lower()}"
    confirmed = listener.listen(TIMEOUT_S, lambda: wanted in (listener.mode, listener.decided_mode))
    if not listener.has_received:
        raise NoServerError(
            f"{sent}, but no message was received on {provider}: is the daemon running, on this bus and with this "
            "vehicle file? (modelserver run -c FILE, --url)"
        )
    now = listener.mode
    if not confirmed and now is not None and not (wanted is Mode.RAW and listener.is_silent(state_hz)):
        why = f" ({listener.rejection})" if listener.rejection else "; was it started with this vehicle file?"
        raise ModelServerError(f"{sent}, but the daemon stays in mode {now.name.lower()}{why}")
    if confirmed or (wanted is Mode.RAW and was is not None):
        before = f" (was {was.name.lower()})" if was is not None else ""
        typer.echo(f"now {wanted.name.lower()}{before}")
    elif not state_hz:
        typer.echo(f"{sent}; it cannot be confirmed: the vehicle file has publish.state_hz: 0")
    else:
        typer.echo(f"{sent}; not confirmed: LOCALIZATION_STATE is silent, as in raw mode and before the first samples")


class ModeListener(DaemonListener):
    """Receive the mode of a daemon: `mode` from its state, `decided_mode` from its decisions since `since`.

    `rejection`: why a command was rejected, from the health report.
    """

    def __init__(self, bus: lcm.LCM, prefix: str, mode_channel: str):
        self.mode: Mode | None = None
        self.decided_mode: Mode | None = None
        self.rejection = ""
        self.since = 0
        # rejected commands that the daemon had counted before
        self._sources = (f"{prefix}{mode_channel}", f"{prefix}{SIGNED}")
        self._counts: dict[tuple[str, str], int] = {}
        self._state_time = 0.0
        handlers: dict[str, Callable[[Any], object]] = {
            "LOCALIZATION_STATE": self._on_state,
            "LOCALIZATION_DECISIONS": self._on_decisions,
            "MODELSERVER_HEALTH": self._on_health,
            "POSE": lambda _: None,
        }
        super().__init__(bus, prefix, handlers)

    def reset(self, since: int) -> None:
        """Drop what was received; decisions count from `since` on."""
        self.mode = self.decided_mode = None
        self.has_received, self.since = False, since

    def is_silent(self, state_hz: float) -> bool:
        """Return whether the last three states are missing: raw mode publishes none."""
        return time.monotonic() - self._state_time > min(3.0 / state_hz, 0.5 * TIMEOUT_S)

    def _on_state(self, state: NavigationState) -> None:
        self.mode, self._state_time = state.mode, time.monotonic()

    def _on_decisions(self, published: PublishDecisions) -> None:
        for each in published.decisions:
            name = each.reason.removeprefix("mode ").upper()
            if each.kind == "mode" and published.utime >= self.since > 0 and name in Mode.__members__:
                self.decided_mode = Mode[name]

    def _on_health(self, health: Health) -> None:
        before = self._counts
        self._counts = {(name, why): count for name, why, count in health.rejected if name in self._sources}
        for source, why, _ in health.rejected:
            if source == f"command:{OPERATOR}":
                self.rejection = why
                break
        if self.since:
            # without an earlier report, earlier rejections count too: they are the likeliest cause
            for (name, why), count in self._counts.items():
                if count > before.get((name, why), 0):
                    self.rejection = f"{why}: {_REASONS.get(why, 'see its log')}"
            ahead = (health.utime - time.time_ns() // 1000) * 1e-6
            if self.rejection.startswith("stale") and abs(ahead) > 1.0:
                side = "ahead of" if ahead > 0 else "behind"
                self.rejection += f"; the daemon's clock is {abs(ahead):.1f} s {side} this one"


_REASONS = {
    "unknown_key": "the daemon has no key of that name: it was started with another key file",
    "bad_signature": "the daemon has another key of that name, or another channel prefix",
    "stale": "too old or in the future by the daemon's clock, or the daemon has just started",
    "replayed": "the daemon has accepted a newer one of this sender; was a clock set back?",
}
"""Descriptions of the daemon's reasons to reject a signed message."""


def parse_mode(text: str) -> Mode:
    """Return the mode of that name. Raises typer.BadParameter, a usage error, with the nearest name."""
    name = text.strip().replace("-", "_").lower()
    return Mode[(name if name in MODES else choose_name(text, MODES, "mode", "MODE")).upper()]
