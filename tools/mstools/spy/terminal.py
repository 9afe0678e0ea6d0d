"""The spy in the terminal: a live table of all channels, and the decoded fields of a selected one."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

import typer

import mslcm
from modelserver.errors import ModelServerError, WireError, find_nearest_names, quote
from modelserver.messages import PoseAnswer
from modelserver.wire.codec import decode, get_type_names
from modelserver.wire.encoded import type_name_of
from modelserver.wire.provider import handle_message
from mstools.spy.fields import format_fields, load_constants
from mstools.spy.traffic import BusTraffic, ChannelStatistics
from mstools.terminal.health_text import format_duration, format_number
from mstools.terminal.output import escape, format_table, replace_unencodable
from mstools.terminal.progress import catch_signals, open_screen

if TYPE_CHECKING:
    import lcm
    from rich.text import Text


class KeyBinding(Enum):
    """A key of the live view: what terminals send for it (ECMA-48 and xterm)."""

    UP = (b"\x1b[A", b"\x1bOA", b"k")
    DOWN = (b"\x1b[B", b"\x1bOB", b"j")
    PAGE_UP = (b"\x1b[5~",)
    PAGE_DOWN = (b"\x1b[6~", b" ")
    HOME = (b"\x1b[H", b"\x1b[1~")
    END = (b"\x1b[F", b"\x1b[4~")
    ENTER = (b"\r", b"\n", b"\x1b[C")
    BACK = (b"\x1b[D", b"\x7f", b"\x1b")
    QUIT = (b"q", b"Q", b"\x03", b"\x04")


_KEYS: Final = {code: key for key in KeyBinding for code in key.value}

_KEY_PATTERN: Final = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Za-z]|.", re.DOTALL)
"""An escape sequence, or a byte."""


def parse_keys(data: bytes) -> Sequence[KeyBinding]:
    """Return the known keys in the input of a terminal."""
    return [_KEYS[piece] for piece in _KEY_PATTERN.findall(data) if piece in _KEYS]


@contextmanager
def open_keyboard() -> Iterator[int]:
    """Let standard input give single keys without echo; yield its descriptor, -1 where it is no terminal."""
    fileno = sys.stdin.fileno() if sys.stdin is not None and sys.stdin.isatty() else -1
    previous = termios.tcgetattr(fileno) if fileno >= 0 else None
    try:
        if previous is not None:
            tty.setcbreak(fileno)
        yield fileno
    finally:
        if previous is not None:
            termios.tcsetattr(fileno, termios.TCSADRAIN, previous)


REFRESH_S: Final = 0.25
"""Refresh period of the live view, seconds."""

LISTEN_S: Final = 2.0
"""Duration of listening for a single table, seconds."""

HEADER: Final = ("channel", "type", "count", "Hz", "jitter ms", "kB/s", "bytes", "age", "bad")

HELP: Final = "up/down select, enter shows the fields, left goes back, q quits"


class BusListener:
    """Subscriber of all channels of a bus."""

    def __init__(self, bus: lcm.LCM, clock: Callable[[], float] = time.monotonic):
        self.traffic = BusTraffic(clock(), type_name_of, is_decodable)
        self._bus, self._clock = bus, clock
        self.fileno = bus.fileno()
        # 0 is no limit: messages that LCM drops could not be counted
        bus.subscribe(".*", lambda channel, data: self.traffic.add(channel, data, clock())).set_queue_capacity(0)

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


_TOP_LEVEL_TYPES: Final = frozenset(get_type_names())


def is_decodable(type_name: str, data: bytes) -> bool:
    """Return whether a message of a known type decodes as the server decodes it."""
    if type_name in _TOP_LEVEL_TYPES:  # others are only parts of messages
        try:
            decode(type_name, data)
        except WireError:
            return False
    return True


def format_rows(traffic: BusTraffic, now: float) -> list[tuple[str, ...]]:
    """Format the rows of the table."""
    rows: list[tuple[str, ...]] = []
    for seen in traffic.list_channels():
        rate, flow = traffic.get_rates(seen, now)
        rows.append(
            (
                truncate(escape(seen.channel), 40),
                seen.type_name or "(unknown)",
                str(seen.count),
                f"{rate:.1f}",
                format_number(seen.jitter * 1e3, 1),
                f"{flow / 1e3:.1f}",
                str(seen.size),
                format_duration(max(0.0, now - seen.last_s)),
                str(seen.undecodable or ""),
            )
        )
    return rows


def format_channel_table(traffic: BusTraffic, now: float, indent: str) -> str:
    """Format the table of all channels."""
    rows = format_rows(traffic, now)
    return replace_unencodable(format_table(HEADER, rows, indent=indent, numbers=range(2, len(HEADER))))


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
    return [*format_fields(message, load_constants()), *_format_geodetic(seen)]


def _format_geodetic(seen: ChannelStatistics) -> list[str]:
    """Format latitude, longitude, height and heading of a pose in a world frame; of another message nothing."""
    try:
        value = decode(seen.type_name, seen.last) if seen.type_name in ("pose_transform_t", "pose_vector_t") else None
    except WireError:
        return []
    geodetic = value.geodetic if isinstance(value, PoseAnswer) else None
    return [] if geodetic is None else ["", f"geodetic: {geodetic}"]


def print_once(listener: BusListener, seconds: float, channel: str = "") -> None:
    """Listen, then print the table and the fields of a channel. Raises ModelServerError if that is silent."""
    listener.listen(time.monotonic() + seconds)
    now, traffic = time.monotonic(), listener.traffic
    typer.echo(f"{format_summary(traffic, now)}, in {seconds:g} s")
    if traffic.channels:
        typer.echo(format_channel_table(traffic, now, ""))
    else:
        typer.echo("no message received: is the daemon running, on this bus (--url)? modelserver doctor checks the bus")
    if channel:
        if channel not in traffic.channels:
            near = ", ".join(quote(each, 64) for each in find_nearest_names(channel, traffic.channels))
            raise ModelServerError(f"no message on {quote(channel, 64)}{f'; nearest: {near}' if near else ''}")
        fields = (f"  {each}" for each in format_message(traffic.channels[channel]))
        typer.echo("\n".join(["", escape(channel), *fields]))


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
        to = {
            KeyBinding.UP: at - 1,
            KeyBinding.DOWN: at + 1,
            KeyBinding.PAGE_UP: at - page,
            KeyBinding.PAGE_DOWN: at + page,
            KeyBinding.HOME: 0,
            KeyBinding.END: len(names) - 1,
        }[key]
        return replace(self, channel=names[max(0, min(to, len(names) - 1))])


def render(traffic: BusTraffic, view: SpyView, now: float, height: int, note: str = HELP) -> Text:
    """Render the table around the selected channel, its fields if they are open, and a note."""
    from rich.text import Text

    text = Text(no_wrap=True, overflow="crop")
    text.append(f"{format_summary(traffic, now)}\n", "bold")
    seen = traffic.list_channels()
    lines = format_channel_table(traffic, now, " ").split("\n")
    text.append(f"{lines[0]}\n", "bold underline")
    names = [each.channel for each in seen]
    at = names.index(view.channel) if view.channel in names else 0
    space = max(1, height - 3)
    found: list[str] = []
    if view.is_open:
        found = format_message(traffic.channels[view.channel]) if view.channel in names else ["no message yet"]
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
    view = SpyView(channel, bool(channel))
    with catch_signals() as stop, open_keyboard() as keyboard, open_screen() as live:
        while not stop.is_set():
            names = [each.channel for each in listener.traffic.list_channels()]
            if not view.channel and names:
                view = replace(view, channel=names[0])
            note = HELP if keyboard >= 0 else "Ctrl-C quits"
            if view.is_open and view.channel not in names and (near := find_nearest_names(view.channel, names)):
                note = f"no message on {escape(view.channel)}; nearest: {', '.join(map(escape, near))}. {note}"
            height = live.console.height
            live.update(render(listener.traffic, view, time.monotonic(), height, note), refresh=True)
            if listener.listen(time.monotonic() + REFRESH_S, keyboard):
                data = os.read(keyboard, 1024)
                # no data: the terminal was closed
                for key in parse_keys(data) if data else [KeyBinding.QUIT]:
                    after = view.handle_key(key, names, max(1, height // 2))
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
