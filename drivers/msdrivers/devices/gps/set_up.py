"""The dialogue that sets a NovAtel receiver up: one command at a time, each acknowledged."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from msdrivers.protocol.novatel import Answer


class SetupProgress(Enum):
    """How far the dialogue is."""

    IDLE = "idle"
    ASKING = "asking"
    DONE = "done"
    UNANSWERED = "unanswered"


class SetUp:
    """Sends commands and awaits their answers. Times are monotonic nanoseconds."""

    def __init__(self, commands: Sequence[str], answer_ns: int, attempts: int) -> None:
        self._commands = tuple(commands)
        self._answer_ns = answer_ns
        self._attempts = attempts
        self._index = 0
        self._tries = 0
        self._settling = False
        """A command was sent more than once, and the other answers may come yet."""
        self._due: int | None = None
        self._last_answer_ns: int | None = None
        self.progress = SetupProgress.IDLE
        self.refused: list[tuple[str, str]] = []
        """Commands that were refused, and the receiver's words."""

    def begin(self, now_ns: int) -> bytes:
        """Start from the first command. Return what to send: an end of line first, for what the port may hold."""
        self._index = self._tries = 0
        self._settling = False
        self.refused = []
        self._last_answer_ns = None
        return b"\r\n" + self._ask(now_ns)

    def stop(self) -> None:
        """Await nothing any more."""
        self.progress = SetupProgress.IDLE
        self._due = None

    def due(self) -> int | None:
        """Return when an answer will have been awaited long enough."""
        return self._due

    def answered(self, answer: Answer, now_ns: int) -> bytes:
        """Take an answer; return what to send next, empty where nothing is."""
        self._last_answer_ns = now_ns
        if self.progress is not SetupProgress.ASKING or self._settling:
            return b""
        if not answer.ok:
            self.refused.append((self._commands[self._index], answer.error))
        self._index += 1
        tries, self._tries = self._tries, 0
        if self._index == len(self._commands):
            self.progress = SetupProgress.DONE
            self._due = None
            return b""
        if tries > 1:
            # each as late as this one; they would pass for answers to the next command
            self._settling = True
            self._due = now_ns + tries * self._answer_ns
            return b""
        return self._ask(now_ns)

    def woken(self, now_ns: int) -> bytes:
        """Send the command again if its answer is overdue; after the last attempt give up."""
        if self._due is None or now_ns < self._due:
            return b""
        self._settling = False
        if self._tries >= self._attempts:
            self.progress = SetupProgress.UNANSWERED
            self._due = None
            return b""
        return self._ask(now_ns)

    def expects_prompt(self, now_ns: int) -> bool:
        """Return whether a prompt belongs to an answer, and is not that of a receiver that has just started."""
        return self.progress is SetupProgress.ASKING or (
            self._last_answer_ns is not None and now_ns - self._last_answer_ns < self._answer_ns
        )

    def _ask(self, now_ns: int) -> bytes:
        self.progress = SetupProgress.ASKING
        self._tries += 1
        self._due = now_ns + self._answer_ns
        return self._commands[self._index].encode("ascii") + b"\r\n"
