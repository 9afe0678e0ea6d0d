"""The table of all channels in the terminal, and the decoded fields of a chosen one."""

from __future__ import annotations

import math
import select
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import typer

import mslcm
from modelserver.errors import ModelServerError, WireError, nearest_names, shown
from modelserver.wire.codec import decode, type_names
from modelserver.wire.kinds import type_name_of
from modelserver.wire.provider import take_message
from mstools.spy.fields import fields
from mstools.spy.keys import KeyBinding, Keyboard
from mstools.spy.traffic import BusTraffic, Seen
from mstools.spy.types import known_constants
from mstools.terminal.interrupts import Interrupts
from mstools.terminal.output import safe
from mstools.terminal.status_text import duration
from mstools.terminal.table import drawable, table

if TYPE_CHECKING:
    import lcm
    from rich.text import Text

REFRESH_S: Final = 0.25
"""Seconds between two pictures."""

LISTEN_S: Final = 2.0
"""For how long is listened where a single picture is wanted."""

HEAD: Final = ("channel", "type", "count", "Hz", "jitter ms", "kB/s", "bytes", "age", "bad")

NUMBERS: Final = tuple(range(2, 9))

HELP: Final = "up/down choose, enter shows the fields, left goes back, q ends"


class BusListener:
    """Hears everything on a bus."""

    def __init__(self, bus: lcm.LCM, clock: Callable[[], float] = time.monotonic):
        self.traffic = BusTraffic(clock(), type_name_of, is_whole)
        self._bus = bus
        self._clock = clock
        self.fileno = bus.fileno()
        # 0 is no limit: what LCM would drop could not be counted
        bus.subscribe(".*", self._heard).set_queue_capacity(0)

    def _heard(self, channel: str, data: bytes) -> None:
        self.traffic.heard(channel, data, self._clock())

    def take(self, until: float) -> None:
        """Take what has come, without waiting, and not for longer than `until`: a flood must not stop the picture."""
        while take_message(self._bus) and self._clock() < until:
            pass

    def listen(self, until: float, also: int = -1) -> bool:
        """Listen until then; return true at once where there is something to read from the file `also`."""
        files = (self.fileno,) if also < 0 else (self.fileno, also)
        while (left := until - self._clock()) > 0.0:
            ready, _, _ = select.select(files, (), (), left)
            if self.fileno in ready:
                self.take(until)
            if also in ready:
                return True
        return False


def is_whole(type_name: str, data: bytes) -> bool:
    """Return whether a message of a known type is one that the service would take."""
    if type_name not in _TOP:
        return True  # a part of others; nobody sends it by itself
    try:
        decode(type_name, data)
    except WireError:
        return False
    return True


_TOP: Final = frozenset(type_names())


def rows(traffic: BusTraffic, now: float) -> list[tuple[str, ...]]:
    """Return the rows of the table."""
    return [_row(traffic, seen, now) for seen in traffic.ordered()]


def _row(traffic: BusTraffic, seen: Seen, now: float) -> tuple[str, ...]:
    rate, flow = traffic.rates(seen, now)
    return (
        shorter(safe(seen.channel), 40),
        seen.type_name or "(unknown)",
        str(seen.count),
        f"{rate:.1f}",
        "-" if math.isnan(seen.jitter) else f"{seen.jitter * 1e3:.1f}",
        f"{flow / 1e3:.1f}",
        str(seen.size),
        duration(max(0.0, now - seen.last_s)),
        str(seen.undecodable or ""),
    )


def shorter(text: str, width: int) -> str:
    """Return a text cut to a width."""
    return text if len(text) <= width else f"{text[: width - 3]}..."


def summary(traffic: BusTraffic, now: float) -> str:
    """Return in a line what came altogether."""
    every = [traffic.rates(seen, now) for seen in traffic.channels.values()]
    text = f"{len(traffic.channels)} channels, {sum(each for each, _ in every):.0f} messages/s, "
    text += f"{sum(each for _, each in every) / 1e3:.1f} kB/s"
    if traffic.others:
        text += f"; {traffic.others} messages on further channels, which are too many to list"
    return text


def message_lines(seen: Seen) -> list[str]:
    """Return the decoded fields of the last message of a channel, or why there are none."""
    if not seen.type_name:
        head = seen.last[:32].hex(" ")
        return ["of no type of this project; it begins with", head or "nothing"]
    try:
        message: Any = getattr(mslcm, seen.type_name).decode(seen.last)
    except Exception as error:
        return [f"a {seen.type_name} that cannot be decoded: {safe(shorter(str(error), 200))}"]
    return fields(message, known_constants())


def print_once(ear: BusListener, seconds: float, channel: str = "") -> None:
    """Listen for a while, print the table and the fields of a channel. Raises ModelServerError where that is silent."""
    ear.listen(time.monotonic() + seconds)
    now, traffic = time.monotonic(), ear.traffic
    typer.echo(f"{summary(traffic, now)}, in {seconds:g} s")
    if traffic.channels:
        typer.echo(drawable(table(HEAD, rows(traffic, now), indent="", numbers=NUMBERS)))
    else:
        typer.echo("nothing was heard: is anyone running, on this bus (--url)? modelserver doctor looks at the bus")
    if channel:
        typer.echo("")
        typer.echo("\n".join([safe(channel), *(f"  {each}" for each in message_lines(_chosen(traffic, channel)))]))


def _chosen(traffic: BusTraffic, channel: str) -> Seen:
    if channel in traffic.channels:
        return traffic.channels[channel]
    near = nearest_names(channel, traffic.channels)
    offer = f"; nearest: {', '.join(shown(each, 64) for each in near)}" if near else ""
    raise ModelServerError(f"nothing came on {shown(channel, 64)}{offer}")


@dataclass(frozen=True, slots=True)
class View:
    """What of the traffic is being looked at: the chosen channel, and whether its fields are shown."""

    channel: str = ""
    is_open: bool = False

    def after(self, key: KeyBinding, names: list[str], page: int) -> View | None:
        """Return the view after a key, None where it ends; `names` are the channels in their order."""
        if key is KeyBinding.QUIT:
            return None
        if key is KeyBinding.ENTER:
            return replace(self, is_open=not self.is_open)
        if key is KeyBinding.BACK:
            return replace(self, is_open=False)
        if not names:
            return self
        at = names.index(self.channel) if self.channel in names else 0
        step = {KeyBinding.UP: -1, KeyBinding.DOWN: 1, KeyBinding.PAGE_UP: -page, KeyBinding.PAGE_DOWN: page}.get(
            key, 0
        )
        to = {KeyBinding.HOME: 0, KeyBinding.END: len(names) - 1}.get(key, at + step)
        return replace(self, channel=names[max(0, min(to, len(names) - 1))])


def picture(traffic: BusTraffic, view: View, now: float, height: int, note: str = HELP) -> Text:
    """Return what is shown: the table around the chosen channel, its fields below where they are open, and a note."""
    from rich.text import Text

    text = Text(no_wrap=True, overflow="crop")
    text.append(f"{summary(traffic, now)}\n", "bold")
    seen = traffic.ordered()
    lines = drawable(table(HEAD, rows(traffic, now), indent=" ", numbers=NUMBERS)).split("\n")
    text.append(f"{lines[0]}\n", "bold underline")
    names = [each.channel for each in seen]
    at = names.index(view.channel) if view.channel in names else 0
    space = max(1, height - 3)
    found: list[str] = []
    if view.is_open:
        chosen = traffic.channels.get(view.channel)
        found = message_lines(chosen) if chosen is not None else ["nothing came yet"]
        # a third for the table, and more where the fields leave it
        space = max(1, min(len(seen), max((height - 6) // 3, height - 6 - len(found))))
    first = max(0, min(at - space // 2, len(seen) - space))
    for number in range(first, min(first + space, len(seen))):
        each = seen[number]
        style = "red" if each.undecodable else "dim" if now - each.last_s > 5.0 or not each.type_name else ""
        text.append(f"{lines[number + 1]}\n", f"{style} reverse".strip() if number == at else style)
    if view.is_open:
        text.append(f"\n{safe(view.channel)}\n", "bold")
        room = max(1, height - space - 6)
        text.append("\n".join(f"  {each}" for each in found[:room]) + "\n")
        if len(found) > room:
            text.append(f"  ... {len(found) - room} lines more: make the terminal higher\n", "dim")
    text.append(note, "dim")
    return text


def watch(ear: BusListener, channel: str = "") -> None:
    """Show the table until q, Ctrl-C, or the order to end."""
    from rich.console import Console
    from rich.live import Live

    console = Console(highlight=False)
    view = View(channel, bool(channel))
    with Interrupts() as stop, Keyboard() as keyboard, Live(console=console, screen=True, auto_refresh=False) as live:
        while not stop.came:
            names = [each.channel for each in ear.traffic.ordered()]
            if not view.channel and names:
                view = replace(view, channel=names[0])
            note = HELP if keyboard.fileno >= 0 else "Ctrl-C ends"
            if view.is_open and view.channel not in names and (near := nearest_names(view.channel, names)):
                note = f"nothing came on {safe(view.channel)}; nearest: {', '.join(map(safe, near))}. {note}"
            live.update(picture(ear.traffic, view, time.monotonic(), console.height, note), refresh=True)
            if ear.listen(time.monotonic() + REFRESH_S, keyboard.fileno):
                for key in keyboard.read():
                    after = view.after(key, names, max(1, console.height // 2))
                    if after is None:
                        return
                    view = after


def show(bus: lcm.LCM, channel: str, seconds: float) -> None:
    """Show the table: live in a terminal, else, or where `seconds` are given, once."""
    ear = BusListener(bus)
    if seconds or not sys.stdout.isatty():
        print_once(ear, seconds or LISTEN_S, channel)
    else:
        watch(ear, channel)
