"""The `modelserver` command in a process of its own, forked from one that has imported it.

To import it again takes 0.2 s of processor time, for each of some hundred processes. Where the start is part of what is
tested, as in the documentation's commands, tests start the interpreter with `support_lcm.MODELSERVER`.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.reduction import DupFd
from pathlib import Path
from typing import IO, Any

from support_lcm import end_process

_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(
    [
        "modelserver.config.vehicle_file",
        "modelserver.server.daemon",
        "modelserver.simulation",
        "msdrivers.settings",
        "mstools.commands.driver",
        "mstools.launch.drive",
    ]
)


class Command(subprocess.Popen[str]):
    """A `modelserver` command that runs: as a `Popen` of it, without what no test uses."""

    def __init__(self, words: Sequence[str], environment: Mapping[str, str], outputs: Mapping[int, int]):
        """Run the words of a command line; `outputs`: a descriptor for each of its own, 1 and 2, that is not ours."""
        given = {own: DupFd(ours) for own, ours in outputs.items()}
        self._process = _FORKS.Process(target=_run, args=(list(words), dict(environment), os.getcwd(), given))
        self._process.daemon = True
        self._process.start()
        assert self._process.pid is not None
        self.args, self.pid, self.returncode = list(words), self._process.pid, None
        self.stdin = self.stdout = self.stderr = None

    def poll(self) -> int | None:
        """Return the exit code, None while it runs; negative: the signal that ended it."""
        self.returncode = self._process.exitcode
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit code once it has ended. Raises subprocess.TimeoutExpired."""
        self._process.join(timeout)
        if (code := self.poll()) is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired(self.args, timeout)
        return code

    def send_signal(self, sig: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, sig)


def _run(words: list[str], environment: dict[str, str], folder: str, outputs: dict[int, Any]) -> None:
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    for own, given in outputs.items():
        descriptor = given.detach()
        os.dup2(descriptor, own)
        os.close(descriptor)
    sys.argv = ["modelserver", *words]

    from mstools.cli import main

    main(words)


@contextmanager
def run_command(
    words: Sequence[str | Path], url: str, stdout: int | IO[str] | None = None, stderr: int | IO[str] | None = None
) -> Iterator[Command]:
    """Run a `modelserver` command on the bus at `url` until the block ends, then end it.

    Its output goes to a file, to `subprocess.DEVNULL`, or by `subprocess.PIPE` to the command's `stdout`.
    """
    outputs: dict[int, int] = {}
    reader = -1
    opened = []
    for own, wanted in ((1, stdout), (2, stderr)):
        if wanted == subprocess.PIPE:
            assert own == 1
            reader, outputs[own] = os.pipe()
            opened.append(outputs[own])
        elif wanted == subprocess.DEVNULL:
            outputs[own] = os.open(os.devnull, os.O_WRONLY)
            opened.append(outputs[own])
        elif wanted is not None:
            assert not isinstance(wanted, int)
            outputs[own] = wanted.fileno()
    try:
        process = Command(list(map(str, words)), os.environ | {"LCM_DEFAULT_URL": url}, outputs)
    finally:
        for descriptor in opened:
            os.close(descriptor)
    if reader >= 0:
        process.stdout = os.fdopen(reader)
    try:
        yield process
    finally:
        end_process(process)
