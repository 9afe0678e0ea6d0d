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


class KeyBinding(Enum):
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

_PIECE: Final = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Za-z]|.", re.DOTALL)
"""A key as terminals send it: an escape sequence (ECMA-48, and xterm's), or a byte."""


def keys(data: bytes) -> Sequence[KeyBinding]:
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

    def read(self) -> Sequence[KeyBinding]:
        """Return the keys that were pressed; to be called when there is something to read."""
        data = os.read(self.fileno, 1024)
        # the terminal is gone: nobody looks any more
        return keys(data) if data else [KeyBinding.QUIT]
