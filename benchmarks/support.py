"""Common parts of the benchmarks: a large model, a daemon as a process, interleaved rounds."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from modelserver.client.remote import Platform
from modelserver.errors import NoServerError
from modelserver.geometry.builder import ModelBuilder
from modelserver.transforms.pose import Pose

ROOT = Path(__file__).resolve().parent.parent
RAPTOR = ROOT / "config" / "raptor"


def build_large_model(frames: int = 10_000, per_body: int = 20) -> ModelBuilder:
    """Return a vehicle of `frames` frames: bodies of `per_body` frames in a tree of ten per level."""
    builder = ModelBuilder("large")
    for number in range(frames // per_body):
        body = builder.add_body(f"Body{number}")
        for frame in range(per_body):
            body.add_frame(f"Frame{frame}", Pose.from_rpy((0.01 * frame, 0.1, -0.2), 0.1, 0.01 * frame, 0.3))
        if number:
            # frames 1 to 10 of a body connect to frame 0 of ten others
            parent, place = divmod(number - 1, 10)
            builder.add_constraint(
                f"Joint{number}", f"Body{parent}:Frame{place + 1}", f"Body{number}:Frame0", Pose((0, 0, 1))
            )
    return builder


MODELSERVER = "import sys; sys.stdout = open('/dev/null', 'w'); from mstools.cli import main; main()"
"""Program of Python that is the command `modelserver`, without its output."""


def free_url() -> str:
    """Return an LCM provider on loopback with an unused port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"udpm://239.255.76.67:{probe.getsockname()[1]}?ttl=0"


def cpu_seconds(pid: int) -> float:
    """Return the CPU time of a process in user and kernel mode."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def run_process(*arguments: str, url: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run Python with arguments in a child process, and end it by its pid."""
    environment = {**os.environ, "LCM_DEFAULT_URL": url, "PYTHONPATH": str(ROOT)}
    child = subprocess.Popen([sys.executable, *arguments], env=environment, stderr=subprocess.DEVNULL)
    try:
        yield child
    finally:
        child.send_signal(signal.SIGTERM)
        try:
            child.wait(5)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


@contextlib.contextmanager
def run_daemon(url: str, config: Path) -> Iterator[Platform]:
    """Run the daemon and return a client that it has answered."""
    with (
        run_process("-c", MODELSERVER, "run", "-c", str(config), "--log-level", "error", url=url),
        Platform(url) as platform,
    ):
        wait_until_answered(platform)
        yield platform


def wait_until_answered(platform: Platform) -> None:
    """Wait until the daemon answers. Raises NoServerError after 20 s."""
    deadline = time.monotonic() + 20.0
    while True:
        try:
            platform.get_body_list()
            return
        except NoServerError:
            if time.monotonic() > deadline:
                raise


def measure_interleaved(rounds: int, calls: int, actions: Mapping[str, Callable[[], object]]) -> dict[str, list[float]]:
    """Return for each action the median seconds of a call per round; the actions alternate within a round.

    A slower machine slows all of them; the ratio of a round stays.
    """
    medians: dict[str, list[float]] = {name: [] for name in actions}
    for _ in range(rounds):
        for name, action in actions.items():
            times = []
            for _ in range(calls):
                begin = time.perf_counter()
                action()
                times.append(time.perf_counter() - begin)
            medians[name].append(statistics.median(times))
    return medians


def ratio(of: Sequence[float], to: Sequence[float]) -> float:
    """Return the median over the rounds of the ratio of two times."""
    return statistics.median(a / b for a, b in zip(of, to, strict=True))


def print_verdict(what: str, measured: float, bound: float, unit: str) -> bool:
    """Print a value beside its bound; return whether it is met."""
    holds = measured <= bound
    print(f"  {what:58} {measured:9.2f} {unit:4} (at most {bound:g}) {'' if holds else '  <-- OUT OF BOUNDS'}")
    return holds
