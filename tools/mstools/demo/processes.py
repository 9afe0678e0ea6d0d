"""Child processes of `modelserver demo`: each ends with the demo, and the failure of one ends the demo."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from modelserver.errors import ModelServerError

STOP_TIMEOUT_S = 3.0
"""Time between SIGTERM and SIGKILL for a child, seconds."""

MODELSERVER = (
    "-c",
    "from mstools.demo.processes import end_with_parent; end_with_parent(); from mstools.cli import main; main()",
)
"""Arguments of Python that run the `modelserver` command of this installation until the demo ends."""


def end_with_parent() -> None:
    """End this process with SIGTERM when its standard input closes, whose other end `ChildProcesses` holds.

    The kernel closes it however the demo ends, SIGKILL included.
    """
    main = threading.main_thread().ident
    assert main is not None

    def watch() -> None:
        while os.read(0, 1):
            pass
        # to the main thread, to interrupt a blocking call there
        signal.pthread_kill(main, signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


class DemoError(ModelServerError):
    """The demo failed; the message is what was missing."""


class ChildProcess(NamedTuple):
    """A child process and its log file."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path


class ChildProcesses:
    """The child processes of the demo; leaving the block ends them, also on an error or SIGTERM."""

    def __init__(self, scratch: Path, verbose: bool):
        self._scratch = scratch
        self._verbose = verbose
        self._started: list[ChildProcess] = []
        self._before: Callable[[int, FrameType | None], object] | int | None = None

    def __enter__(self) -> ChildProcesses:
        def on_sigterm(number: int, frame: FrameType | None) -> None:
            raise SystemExit(128 + number)

        self._before = signal.signal(signal.SIGTERM, on_sigterm)
        return self

    def __exit__(self, *_: object) -> None:
        # a second Ctrl-C must not skip the rest
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            for child in self._started:
                child.process.terminate()
            deadline = time.monotonic() + STOP_TIMEOUT_S
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

    def start(self, name: str, *arguments: str) -> None:
        """Start a Python process with these arguments."""
        log = self._scratch / f"{len(self._started)}.log"
        environment = os.environ | {"STATE_DIRECTORY": str(self._scratch)}
        with contextlib.nullcontext() if self._verbose else log.open("wb") as output:
            # a session of its own: Ctrl-C reaches only the demo, which ends them in order; nothing is written to its
            # standard input, which closes when the demo ends
            process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                env=environment,
                start_new_session=True,
            )
        self._started.append(ChildProcess(name, process, log))

    def check(self) -> None:
        """Raise DemoError with the last output of a process that has ended: all must run until the end of the demo."""
        for child in self._started:
            code = child.process.poll()
            if code is not None:
                output = child.log.read_text(errors="replace").strip() if child.log.exists() else ""
                tail = "\n  ".join(output.splitlines()[-8:]) or "(nothing)"
                reason = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
                raise DemoError(f"the {child.name} {reason}. Its output:\n  {tail}")
