"""`modelserver mode`: which sources localization uses, told to the running daemon."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modelserver.errors import (
    ConfigError,
    Location,
    ModelServerError,
    NoServerError,
    Problem,
    Severity,
    nearest_names,
    shown,
)
from modelserver.keys import ENVIRONMENT
from modelserver.messages import Health, Mode, NavigationState, PublishDecisions, SensorHeader, SwitchMode
from modelserver.wire.provider import open_lcm, resolve_url
from modelserver.wire.signed import SIGNED
from mstools.commands.asking import KeyOption, UrlOption, handle_until

if TYPE_CHECKING:
    import lcm

MODES = tuple(mode.name.lower() for mode in Mode)

PATIENCE_S = 2.0
"""How long the daemon is waited for, seconds."""

OPERATOR = "operator"
"""The name under which wishes go out."""


def command(
    mode: Annotated[str, typer.Argument(metavar="MODE", help=f"One of {', '.join(MODES)}.")],
    config: Annotated[Path, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file.")],
    url: UrlOption = "",
    key: KeyOption = None,
) -> None:
    """Tell the running daemon which sources its localization is to use from now on, and say what it does.

    The wish goes out once, signed, for the channel that the vehicle file names (localization.mode_channel); the daemon
    must have been started with the same. It is signed with the key of --key, else of $MODELSERVER_KEY_FILE, else of the
    vehicle file (commands.key_file). Then LOCALIZATION_STATE and LOCALIZATION_DECISIONS are listened to for up to two
    seconds: they tell which mode is in force. Exits 1 where nobody answers, or the mode stays another.

    Example: modelserver mode no_gps -c config/husky/vehicle.yaml
    """
    wanted = parse_mode(mode)
    from modelserver.client.signing import signer
    from modelserver.config import load_config
    from modelserver.wire.codec import encode

    vehicle = load_config(config)
    if not vehicle.localization.mode_channel:
        why = "the vehicle file names no channel for wishes about the mode, so the daemon hears none"
        fix = "write mode_channel: LOCALIZATION_MODE under localization, and start the daemon anew"
        source = Location(str(config), element="localization.mode_channel")
        raise ConfigError([Problem(Severity.ERROR, why, source, fix)])
    prefix, state_hz = vehicle.lcm.channel_prefix, vehicle.publish.state_hz
    channel = f"{prefix}{vehicle.localization.mode_channel}"
    given = str(key or "") or os.environ.get(ENVIRONMENT, "") or vehicle.commands.key_file
    signing = signer(given, prefix, "modelserver")
    if signing is None:
        raise ModelServerError(f"the wish must be signed: name the daemon's key with --key or ${ENVIRONMENT}")
    provider = resolve_url(url or vehicle.lcm.url)
    bus = open_lcm(provider)
    ear = ModeListener(bus, prefix, vehicle.localization.mode_channel)
    if state_hz:
        ear.listen(min(PATIENCE_S, 2.5 / state_hz), lambda: ear.mode is not None)
    was = ear.mode
    utime = time.time_ns() // 1000
    ear.forget(utime)
    wish = encode(SwitchMode(SensorHeader(utime, OPERATOR, host_utime=utime), wanted))
    bus.publish(signing.channel, signing.sealed(vehicle.localization.mode_channel, wish))
    told = f"told {channel}: {wanted.name.lower()}"
    confirmed = ear.listen(PATIENCE_S, lambda: wanted in (ear.mode, ear.decided))
    if not ear.heard:
        raise NoServerError(
            f"{told}, but nobody answers on {provider}: is the daemon running, on this bus and with this "
            "vehicle file? (modelserver run -c FILE, --url)"
        )
    now = ear.mode
    if not confirmed and now is not None and not (wanted is Mode.RAW and ear.is_silent(state_hz)):
        why = f" ({ear.refusal})" if ear.refusal else "; was it started with this vehicle file?"
        raise ModelServerError(f"{told}, but the daemon stays in mode {now.name.lower()}{why}")
    if confirmed or (wanted is Mode.RAW and was is not None):
        before = f" (was {was.name.lower()})" if was is not None else ""
        typer.echo(f"now {wanted.name.lower()}{before}")
    elif not state_hz:
        typer.echo(f"{told}; it cannot be confirmed: the vehicle file has publish.state_hz: 0")
    else:
        typer.echo(f"{told}; not confirmed: LOCALIZATION_STATE is silent, as in raw mode and before the first samples")


class ModeListener:
    """Hears what a daemon says of its mode: `mode` by its state, `decided` by its decisions, `heard` anything at all.

    `since`: wishes of before count for nothing. `refusal`: why a wish was refused, by the health report.
    """

    def __init__(self, bus: lcm.LCM, prefix: str, mode_channel: str):
        from modelserver.wire.channels import literal

        self.heard = False
        self.mode: Mode | None = None
        self.decided: Mode | None = None
        self.refusal = ""
        self.since = 0
        # what the daemon counted of signed wishes that it did not obey; before this one, for later it is compared
        self._sources = (f"{prefix}{mode_channel}", f"{prefix}{SIGNED}")
        self._counts: dict[tuple[str, str], int] = {}
        self._bus = bus
        self._state_at = 0.0
        handlers = {
            "LOCALIZATION_STATE": self._on_state,
            "LOCALIZATION_DECISIONS": self._on_decisions,
            "MODELSERVER_HEALTH": self._on_health,
            "POSE": self._on_pose,
        }
        for name, handler in handlers.items():
            bus.subscribe(literal(f"{prefix}{name}"), handler)

    def forget(self, since: int) -> None:
        """Forget what was heard of the mode; from an instant on it counts."""
        self.mode = self.decided = None
        self.heard, self.since = False, since

    def listen(self, seconds: float, until: Callable[[], bool]) -> bool:
        """Listen until something is so, for so long at most; return whether it is."""
        return handle_until(self._bus, seconds, until)

    def is_silent(self, state_hz: float) -> bool:
        """Return whether the last three reports of the state are missing: raw mode has none."""
        return time.monotonic() - self._state_at > min(3.0 / state_hz, 0.5 * PATIENCE_S)

    def _on_state(self, _: str, data: bytes) -> None:
        from modelserver.wire.codec import decode

        state: NavigationState = decode("navigation_state_t", data)
        self.heard, self.mode, self._state_at = True, state.mode, time.monotonic()

    def _on_decisions(self, _: str, data: bytes) -> None:
        from modelserver.wire.codec import decode

        told: PublishDecisions = decode("decisions_t", data)
        self.heard = True
        for each in told.decisions:
            name = each.reason.removeprefix("mode ").upper()
            if each.kind == "mode" and told.utime >= self.since > 0 and name in Mode.__members__:
                self.decided = Mode[name]

    def _on_health(self, _: str, data: bytes) -> None:
        from modelserver.wire.codec import decode

        health: Health = decode("health_t", data)
        self.heard = True
        self.refusal = next(
            (why for source, why, _ in health.rejected if source == f"command:{OPERATOR}"), self.refusal
        )
        counts = {(name, why): count for name, why, count in health.rejected if name in self._sources}
        # where nothing was heard before the wish, what was refused earlier counts too: it is the likeliest cause
        before, self._counts = self._counts, counts
        if self.since:
            for (name, why), count in counts.items():
                if count > before.get((name, why), 0):
                    self.refusal = f"{why}: {_WHY.get(why, 'see its log')}"
            ahead = (health.utime - time.time_ns() // 1000) * 1e-6
            if self.refusal.startswith("stale") and abs(ahead) > 1.0:
                side = "ahead of" if ahead > 0 else "behind"
                self.refusal += f"; the daemon's clock is {abs(ahead):.1f} s {side} this one"

    def _on_pose(self, _: str, data: bytes) -> None:
        self.heard = True


_WHY = {
    "unknown_key": "the daemon has no key of that name; it was started with another key file",
    "bad_signature": "the daemon's key of that name is another one, or its channel prefix",
    "stale": "it is too old or of the future by the daemon's clock, or the daemon has just started",
    "replayed": "the daemon took a newer one of this sender; was a clock set back?",
}
"""Reasons that the daemon counts for signed messages, in words."""


def parse_mode(text: str) -> Mode:
    """Return the mode of that name. Raises typer.BadParameter, a usage error, with the nearest for another name."""
    name = text.strip().replace("-", "_").upper()
    if name in Mode.__members__:
        return Mode[name]
    near = nearest_names(name, MODES)
    hint = f"did you mean {near[0]}?" if near else f"there are: {', '.join(MODES)}"
    raise typer.BadParameter(f"{shown(text, 40)} is no mode; {hint}", param_hint="MODE")
