"""The processes of `modelserver demo`: all ended by their ids, whatever happens, and told of when one fails."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import IO

from modelserver.errors import ModelServerError

STOP_LIMIT = 3.0
"""How long a child may take to end after SIGTERM, seconds."""

MODELSERVER = (
    "-c",
    "from mstools.demo.children import end_with_parent; end_with_parent(); from mstools.cli import main; main()",
)
"""What makes Python the `modelserver` command of this installation, wherever its script is; it ends with the demo."""


def end_with_parent() -> None:
    """End this process, as SIGTERM does, when its standard input ends: `Children` holds the other end of it.

    However the demo ends, SIGKILL included, the system closes that, and nothing is left behind.
    """
    main = threading.main_thread().ident
    assert main is not None

    def watch() -> None:
        while os.read(0, 1):
            pass
        # to that thread: a call that waits there is interrupted only so
        signal.pthread_kill(main, signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


class DemoError(ModelServerError):
    """The demo did not show what it should; the message says what was missing."""


@dataclass(slots=True)
class Child:
    """A process that the demo started, and the file that what it says goes to."""

    what: str
    process: subprocess.Popen[bytes]
    said: Path


class Children:
    """The processes of the demo. Leaving the block ends them, whatever happened in it, SIGTERM included."""

    def __init__(self, scratch: Path, verbose: bool):
        self._scratch = scratch
        self._verbose = verbose
        self._started: list[Child] = []
        self._before: Callable[[int, FrameType | None], object] | int | None = None

    def __enter__(self) -> Children:
        def ended(number: int, frame: FrameType | None) -> None:
            raise SystemExit(128 + number)

        self._before = signal.signal(signal.SIGTERM, ended)
        return self

    def __exit__(self, *_: object) -> None:
        # a second Ctrl-C must not leave them behind
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            for child in self._started:
                child.process.terminate()
            deadline = time.monotonic() + STOP_LIMIT
            for child in self._started:
                try:
                    child.process.wait(max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    child.process.kill()
                    child.process.wait()
                assert child.process.stdin is not None
                child.process.stdin.close()
        finally:
            signal.signal(signal.SIGINT, before)
            signal.signal(signal.SIGTERM, self._before)

    def start(self, what: str, *arguments: str) -> None:
        """Start a Python process with these arguments."""
        said = self._scratch / f"{len(self._started)}.log"
        environment = os.environ | {"STATE_DIRECTORY": str(self._scratch)}
        with contextlib.ExitStack() as stack:
            output: IO[bytes] | None = None if self._verbose else stack.enter_context(said.open("wb"))
            # a session of its own: Ctrl-C comes to the demo alone, which then ends them in order
            process = subprocess.Popen(
                [sys.executable, *arguments],
                # nothing is ever said on it: its end tells that the demo has ended
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                env=environment,
                start_new_session=True,
            )
        self._started.append(Child(what, process, said))

    def check(self) -> None:
        """Raise DemoError, with what it said last, where a process has ended: all are to run until they are told."""
        for child in self._started:
            code = child.process.poll()
            if code is not None:
                said = child.said.read_text(errors="replace").strip() if child.said.exists() else ""
                tail = "\n  ".join(said.splitlines()[-8:]) or "(nothing)"
                how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
                raise DemoError(f"the {child.what} {how}. It said:\n  {tail}")
