"""The keys that someone presses while a picture is being shown in the terminal."""

from __future__ import annotations

import os
import re
import sys
import termios
import tty
from collections.abc import Sequence
from enum import Enum, auto
from types import TracebackType
from typing import Any, Final


class Key(Enum):
    """A key that does something."""

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
    b"\x1b[A": Key.UP,
    b"\x1bOA": Key.UP,
    b"k": Key.UP,
    b"\x1b[B": Key.DOWN,
    b"\x1bOB": Key.DOWN,
    b"j": Key.DOWN,
    b"\x1b[5~": Key.PAGE_UP,
    b"\x1b[6~": Key.PAGE_DOWN,
    b" ": Key.PAGE_DOWN,
    b"\x1b[H": Key.HOME,
    b"\x1b[1~": Key.HOME,
    b"\x1b[F": Key.END,
    b"\x1b[4~": Key.END,
    b"\r": Key.ENTER,
    b"\n": Key.ENTER,
    b"\x1b[C": Key.ENTER,
    b"\x1b[D": Key.BACK,
    b"\x7f": Key.BACK,
    b"\x1b": Key.BACK,
    b"q": Key.QUIT,
    b"Q": Key.QUIT,
    b"\x03": Key.QUIT,
    b"\x04": Key.QUIT,
}

_PIECE: Final = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Za-z]|.", re.DOTALL)
"""A key as terminals send it: an escape sequence (ECMA-48, and xterm's), or a byte."""


def keys(data: bytes) -> Sequence[Key]:
    """Return the keys in what a terminal has sent; others are left out."""
    return [_KEYS[piece] for piece in _PIECE.findall(data) if piece in _KEYS]


class Keyboard:
    """Standard input key by key, without echo; as it was before at the end. Nothing where it is no terminal."""

    def __init__(self) -> None:
        self.fileno = sys.stdin.fileno() if sys.stdin is not None and sys.stdin.isatty() else -1
        self._before: list[Any] | None = None

    def __enter__(self) -> Keyboard:
        if self.fileno >= 0:
            self._before = termios.tcgetattr(self.fileno)
            tty.setcbreak(self.fileno)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._before is not None:
            termios.tcsetattr(self.fileno, termios.TCSADRAIN, self._before)

    def read(self) -> Sequence[Key]:
        """Return the keys that were pressed; to be called when there is something to read."""
        data = os.read(self.fileno, 1024)
        # the terminal is gone: nobody looks any more
        return keys(data) if data else [Key.QUIT]
