"""Configuration of a NovAtel receiver: one command at a time, each acknowledged, with timeout and retries.

After a retry more than one response may arrive. Before the next command the dialogue waits for them, so that none is
taken for the response to that command.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from msdrivers.protocol.novatel import CommandResponse


class SetupProgress(Enum):
    """State of the dialogue."""

    IDLE = "idle"
    RUNNING = "asking"
    DONE = "done"
    TIMED_OUT = "unanswered"


class SetupDialogue:
    """Sends commands and awaits their responses. Times are monotonic nanoseconds."""

    def __init__(self, commands: Sequence[str], answer_ns: int, attempts: int) -> None:
        self._commands = tuple(commands)
        self._timeout_ns = answer_ns
        self._attempts = attempts
        self._index = 0
        self._attempt = 0
        self._is_settling = False
        """A command was sent more than once; further responses may arrive."""
        self._deadline_ns: int | None = None
        self._last_answer_ns: int | None = None
        self.progress = SetupProgress.IDLE
        self.rejected: list[tuple[str, str]] = []
        """Rejected commands and the receiver's error texts."""

    def start(self, now_ns: int) -> bytes:
        """Start from the first command; return the bytes to send, with an end of line first to flush partial input."""
        self._index = self._attempt = 0
        self._is_settling = False
        self.rejected = []
        self._last_answer_ns = None
        return b"\r\n" + self._send_command(now_ns)

    def stop(self) -> None:
        """Stop waiting for responses."""
        self.progress = SetupProgress.IDLE
        self._deadline_ns = None

    def get_deadline(self) -> int | None:
        """Return the response deadline, monotonic nanoseconds."""
        return self._deadline_ns

    def on_response(self, answer: CommandResponse, now_ns: int) -> bytes:
        """Process a response; return the next bytes to send, or none."""
        self._last_answer_ns = now_ns
        if self.progress is not SetupProgress.RUNNING or self._is_settling:
            return b""
        if not answer.is_ok:
            self.rejected.append((self._commands[self._index], answer.error))
        self._index += 1
        tries, self._attempt = self._attempt, 0
        if self._index == len(self._commands):
            self.progress = SetupProgress.DONE
            self._deadline_ns = None
            return b""
        if tries > 1:
            # each as late as this one; they would pass for answers to the next command
            self._is_settling = True
            self._deadline_ns = now_ns + tries * self._timeout_ns
            return b""
        return self._send_command(now_ns)

    def on_timer(self, now_ns: int) -> bytes:
        """Repeat the command after a timeout; stop after the last attempt."""
        if self._deadline_ns is None or now_ns < self._deadline_ns:
            return b""
        self._is_settling = False
        if self._attempt >= self._attempts:
            self.progress = SetupProgress.TIMED_OUT
            self._deadline_ns = None
            return b""
        return self._send_command(now_ns)

    def expects_prompt(self, now_ns: int) -> bool:
        """Return whether a prompt belongs to a response, and is not that of a restarted receiver."""
        return self.progress is SetupProgress.RUNNING or (
            self._last_answer_ns is not None and now_ns - self._last_answer_ns < self._timeout_ns
        )

    def _send_command(self, now_ns: int) -> bytes:
        self.progress = SetupProgress.RUNNING
        self._attempt += 1
        self._deadline_ns = now_ns + self._timeout_ns
        return self._commands[self._index].encode("ascii") + b"\r\n"
