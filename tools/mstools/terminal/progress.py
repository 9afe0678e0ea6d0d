"""Output that changes: a progress bar on stderr, a live display, and the signals that end it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.live import Live


@contextmanager
def show_progress(label: str, total: float) -> Iterator[Callable[[float], None]]:
    """Show a progress bar while the block runs; the block calls the given function with the part of `total` done.

    Nothing is shown where stderr is no terminal.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=total)
        yield lambda done: bar.update(task, completed=done)


def open_screen() -> Live:
    """Return a display of the whole terminal, for a `with` block."""
    from rich.console import Console
    from rich.live import Live

    return Live(console=Console(highlight=False), screen=True, auto_refresh=False)


@contextmanager
def catch_signals() -> Iterator[Event]:
    """Within the block, SIGINT, SIGTERM and SIGHUP set the event and do nothing else.

    KeyboardInterrupt is no alternative: LCM's binding raises it, and Python raises it again for the same signal; and
    SIGTERM would not restore the terminal.
    """
    stop = Event()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    previous = {number: signal.signal(number, lambda *_: stop.set()) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
