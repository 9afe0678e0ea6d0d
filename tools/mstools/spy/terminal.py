"""The spy in the terminal: a live table of all channels, and the decoded fields of a selected one."""

from __future__ import annotations

import math
import os
import re
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

import typer

import mslcm
from modelserver.errors import ModelServerError, WireError, find_nearest_names, quote
from modelserver.wire.codec import decode, get_type_names
from modelserver.wire.encoded import type_name_of
from modelserver.wire.provider import handle_message
from mstools.spy.fields import format_fields, load_constants
from mstools.spy.traffic import BusTraffic, ChannelStatistics
from mstools.terminal.health_text import format_duration
from mstools.terminal.interrupts import Interrupts
from mstools.terminal.output import escape, format_table, replace_unencodable

if TYPE_CHECKING:
    import lcm
    from rich.text import Text


class KeyBinding(Enum):
    """A key of the live view."""

    UP = auto()
    DOWN = auto()
    PAGE_UP = auto()
    PAGE_DOWN = auto()
    HOME = auto()
    END = auto()
    ENTER = auto()
    BACK = auto()
    QUIT = auto()


_KEYS: Final = {
    b"\x1b[A": KeyBinding.UP,
    b"\x1bOA": KeyBinding.UP,
    b"k": KeyBinding.UP,
    b"\x1b[B": KeyBinding.DOWN,
    b"\x1bOB": KeyBinding.DOWN,
    b"j": KeyBinding.DOWN,
    b"\x1b[5~": KeyBinding.PAGE_UP,
    b"\x1b[6~": KeyBinding.PAGE_DOWN,
    b" ": KeyBinding.PAGE_DOWN,
    b"\x1b[H": KeyBinding.HOME,
    b"\x1b[1~": KeyBinding.HOME,
    b"\x1b[F": KeyBinding.END,
    b"\x1b[4~": KeyBinding.END,
    b"\r": KeyBinding.ENTER,
    b"\n": KeyBinding.ENTER,
    b"\x1b[C": KeyBinding.ENTER,
    b"\x1b[D": KeyBinding.BACK,
    b"\x7f": KeyBinding.BACK,
    b"\x1b": KeyBinding.BACK,
    b"q": KeyBinding.QUIT,
    b"Q": KeyBinding.QUIT,
    b"\x03": KeyBinding.QUIT,
    b"\x04": KeyBinding.QUIT,
}

_KEY_PATTERN: Final = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Za-z]|.", re.DOTALL)
"""A key as a terminal sends it: an escape sequence (ECMA-48 and xterm), or a byte."""


def parse_keys(data: bytes) -> Sequence[KeyBinding]:
    """Return the known keys in the input of a terminal."""
    return [_KEYS[piece] for piece in _KEY_PATTERN.findall(data) if piece in _KEYS]


class Keyboard:
    """Standard input as single keys without echo; `fileno` is -1 where it is no terminal."""

    def __init__(self) -> None:
        self.fileno = sys.stdin.fileno() if sys.stdin is not None and sys.stdin.isatty() else -1
        self._previous: list[Any] | None = None

    def __enter__(self) -> Keyboard:
        if self.fileno >= 0:
            self._previous = termios.tcgetattr(self.fileno)
            tty.setcbreak(self.fileno)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._previous is not None:
            termios.tcsetattr(self.fileno, termios.TCSADRAIN, self._previous)

    def read(self) -> Sequence[KeyBinding]:
        """Read the pressed keys; call it when `fileno` is ready."""
        data = os.read(self.fileno, 1024)
        # no data: the terminal was closed
        return parse_keys(data) if data else [KeyBinding.QUIT]


REFRESH_S: Final = 0.25
"""Refresh period of the live view, seconds."""

LISTEN_S: Final = 2.0
"""Duration of listening for a single table, seconds."""

HEADER: Final = ("channel", "type", "count", "Hz", "jitter ms", "kB/s", "bytes", "age", "bad")

NUMERIC_COLUMNS: Final = tuple(range(2, 9))

HELP: Final = "up/down select, enter shows the fields, left goes back, q quits"


class BusListener:
    """Subscriber of all channels of a bus."""

    def __init__(self, bus: lcm.LCM, clock: Callable[[], float] = time.monotonic):
        self.traffic = BusTraffic(clock(), type_name_of, is_decodable)
        self._bus = bus
        self._clock = clock
        self.fileno = bus.fileno()
        # 0 is no limit: messages that LCM drops could not be counted
        bus.subscribe(".*", self._on_message).set_queue_capacity(0)

    def _on_message(self, channel: str, data: bytes) -> None:
        self.traffic.add(channel, data, self._clock())

    def drain(self, until: float) -> None:
        """Process the queued messages, but not after `until`: a flood must not stop the display."""
        while handle_message(self._bus) and self._clock() < until:
            pass

    def listen(self, until: float, extra_file: int = -1) -> bool:
        """Listen until that time; return True at once when `extra_file` is readable."""
        files = (self.fileno,) if extra_file < 0 else (self.fileno, extra_file)
        while (left := until - self._clock()) > 0.0:
            ready, _, _ = select.select(files, (), (), left)
            if self.fileno in ready:
                self.drain(until)
            if extra_file in ready:
                return True
        return False


def is_decodable(type_name: str, data: bytes) -> bool:
    """Return whether a message of a known type decodes as the server decodes it."""
    if type_name not in _TOP_LEVEL_TYPES:
        return True  # only a part of other messages
    try:
        decode(type_name, data)
    except WireError:
        return False
    return True


_TOP_LEVEL_TYPES: Final = frozenset(get_type_names())


def format_rows(traffic: BusTraffic, now: float) -> list[tuple[str, ...]]:
    """Format the rows of the table."""
    return [_format_row(traffic, seen, now) for seen in traffic.list_channels()]


def _format_row(traffic: BusTraffic, seen: ChannelStatistics, now: float) -> tuple[str, ...]:
    rate, flow = traffic.get_rates(seen, now)
    return (
        truncate(escape(seen.channel), 40),
        seen.type_name or "(unknown)",
        str(seen.count),
        f"{rate:.1f}",
        "-" if math.isnan(seen.jitter) else f"{seen.jitter * 1e3:.1f}",
        f"{flow / 1e3:.1f}",
        str(seen.size),
        format_duration(max(0.0, now - seen.last_s)),
        str(seen.undecodable or ""),
    )


def truncate(text: str, width: int) -> str:
    """Truncate a text to a width."""
    return text if len(text) <= width else f"{text[: width - 3]}..."


def format_summary(traffic: BusTraffic, now: float) -> str:
    """Format the totals of the bus in one line."""
    every = [traffic.get_rates(seen, now) for seen in traffic.channels.values()]
    text = f"{len(traffic.channels)} channels, {sum(each for each, _ in every):.0f} messages/s, "
    text += f"{sum(each for _, each in every) / 1e3:.1f} kB/s"
    if traffic.others:
        text += f"; {traffic.others} messages on further channels (too many to list)"
    return text


def format_message(seen: ChannelStatistics) -> list[str]:
    """Format the decoded fields of a channel's last message, or the reason why there are none."""
    if not seen.type_name:
        head = seen.last[:32].hex(" ")
        return ["unknown type; its first bytes are", head or "nothing"]
    try:
        message: Any = getattr(mslcm, seen.type_name).decode(seen.last)
    except Exception as error:
        return [f"{seen.type_name} that cannot be decoded: {escape(truncate(str(error), 200))}"]
    return format_fields(message, load_constants())


def print_once(listener: BusListener, seconds: float, channel: str = "") -> None:
    """Listen, then print the table and the fields of a channel. Raises ModelServerError if that is silent."""
    listener.listen(time.monotonic() + seconds)
    now, traffic = time.monotonic(), listener.traffic
    typer.echo(f"{format_summary(traffic, now)}, in {seconds:g} s")
    if traffic.channels:
        typer.echo(
            replace_unencodable(format_table(HEADER, format_rows(traffic, now), indent="", numbers=NUMERIC_COLUMNS))
        )
    else:
        typer.echo("no message received: is the daemon running, on this bus (--url)? modelserver doctor checks the bus")
    if channel:
        typer.echo("")
        typer.echo(
            "\n".join([escape(channel), *(f"  {each}" for each in format_message(_select_channel(traffic, channel)))])
        )


def _select_channel(traffic: BusTraffic, channel: str) -> ChannelStatistics:
    if channel in traffic.channels:
        return traffic.channels[channel]
    near = find_nearest_names(channel, traffic.channels)
    offer = f"; nearest: {', '.join(quote(each, 64) for each in near)}" if near else ""
    raise ModelServerError(f"no message on {quote(channel, 64)}{offer}")


@dataclass(frozen=True, slots=True)
class SpyView:
    """The selected channel, and whether its fields are shown."""

    channel: str = ""
    is_open: bool = False

    def handle_key(self, key: KeyBinding, names: list[str], page: int) -> SpyView | None:
        """Return the view after a key, None for quit; `names` are the channels in display order."""
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


def render(traffic: BusTraffic, view: SpyView, now: float, height: int, note: str = HELP) -> Text:
    """Render the table around the selected channel, its fields if they are open, and a note."""
    from rich.text import Text

    text = Text(no_wrap=True, overflow="crop")
    text.append(f"{format_summary(traffic, now)}\n", "bold")
    seen = traffic.list_channels()
    lines = replace_unencodable(
        format_table(HEADER, format_rows(traffic, now), indent=" ", numbers=NUMERIC_COLUMNS)
    ).split("\n")
    text.append(f"{lines[0]}\n", "bold underline")
    names = [each.channel for each in seen]
    at = names.index(view.channel) if view.channel in names else 0
    space = max(1, height - 3)
    found: list[str] = []
    if view.is_open:
        selected = traffic.channels.get(view.channel)
        found = format_message(selected) if selected is not None else ["no message yet"]
        # a third for the table, more if the fields leave it
        space = max(1, min(len(seen), max((height - 6) // 3, height - 6 - len(found))))
    first = max(0, min(at - space // 2, len(seen) - space))
    for number in range(first, min(first + space, len(seen))):
        each = seen[number]
        style = "red" if each.undecodable else "dim" if now - each.last_s > 5.0 or not each.type_name else ""
        text.append(f"{lines[number + 1]}\n", f"{style} reverse".strip() if number == at else style)
    if view.is_open:
        text.append(f"\n{escape(view.channel)}\n", "bold")
        room = max(1, height - space - 6)
        text.append("\n".join(f"  {each}" for each in found[:room]) + "\n")
        if len(found) > room:
            text.append(f"  ... {len(found) - room} more lines: enlarge the terminal\n", "dim")
    text.append(note, "dim")
    return text


def watch(listener: BusListener, channel: str = "") -> None:
    """Show the live table until q, Ctrl-C or SIGTERM."""
    from rich.console import Console
    from rich.live import Live

    console = Console(highlight=False)
    view = SpyView(channel, bool(channel))
    with Interrupts() as stop, Keyboard() as keyboard, Live(console=console, screen=True, auto_refresh=False) as live:
        while not stop.is_set:
            names = [each.channel for each in listener.traffic.list_channels()]
            if not view.channel and names:
                view = replace(view, channel=names[0])
            note = HELP if keyboard.fileno >= 0 else "Ctrl-C quits"
            if view.is_open and view.channel not in names and (near := find_nearest_names(view.channel, names)):
                note = f"no message on {escape(view.channel)}; nearest: {', '.join(map(escape, near))}. {note}"
            live.update(render(listener.traffic, view, time.monotonic(), console.height, note), refresh=True)
            if listener.listen(time.monotonic() + REFRESH_S, keyboard.fileno):
                for key in keyboard.read():
                    after = view.handle_key(key, names, max(1, console.height // 2))
                    if after is None:
                        return
                    view = after


def show(bus: lcm.LCM, channel: str, seconds: float) -> None:
    """Show the table live in a terminal, else, or with `seconds`, print it once."""
    listener = BusListener(bus)
    if seconds or not sys.stdout.isatty():
        print_once(listener, seconds or LISTEN_S, channel)
    else:
        watch(listener, channel)
