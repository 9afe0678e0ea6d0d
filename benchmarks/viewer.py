"""Cost of the viewer beside a service with POSE at 100 Hz: pictures per second, CPU, latency of ticks; opening a log.

    python -m benchmarks viewer

The Raptor on emulated devices runs with and without a viewer in turns, three each, of `SECONDS`. Then a browser shows
the whole page (scene, map, plots), for the viewer's own processor time: on this machine it competes with the service
for processors, above all without a graphics card, so that latencies are measured without it. What the service publishes
is written to a log, which is then opened.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree, which
from typing import TYPE_CHECKING

import lcm

from benchmarks.support import RAPTOR, free_url, print_verdict, run_process
from modelserver.messages import Health
from modelserver.wire.codec import decode

if TYPE_CHECKING:
    from collections.abc import Iterator

SKIPPED = 77
RATE_HZ = 100
SECONDS = 15.0
ROUNDS = 3
START_S = 15.0
"""Time until the emulated vehicle has a pose."""

CPU_BOUND = 10.0
"""Percent of a core."""
PICTURES_BOUND = 44.0
"""Milliseconds a picture: some pictures of 25 a second are missed on a busy machine."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PAGE_S = 10.0
"""Time for a browser to load the page."""
LATENCY_BOUND = 1.0
"""Milliseconds by which the median latency of a tick may be larger with a viewer."""
OPEN_BOUND = 30.0
"""Seconds of processor time for an hour of log."""

_RUN = "import sys; sys.stdout = open('/dev/null', 'w'); from mstools.cli import main; main()"


class Recorder:
    """Write what is published to a log, and keep the health reports."""

    def __init__(self, url: str, path: Path):
        self.reports: list[Health] = []
        self._log = lcm.EventLog(str(path), "w", overwrite=True)
        self._bus = lcm.LCM(url)
        self._bus.subscribe(".*", self._receive)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _receive(self, channel: str, data: bytes) -> None:
        self._log.write_event(time.time_ns() // 1000, channel, data)
        if channel == "MODELSERVER_HEALTH":
            self.reports.append(decode("health_t", data))

    def _run(self) -> None:
        while not self._stop.is_set():
            self._bus.handle_timeout(100)

    def close(self) -> None:
        """Leave the bus and end the log."""
        self._stop.set()
        self._thread.join()
        self._log.close()


@contextmanager
def run_viewer(url: str) -> Iterator[tuple[list[float], str]]:
    """Run a viewer of the service; yield a list with the time of each picture, and the link of its page."""
    from mstools.view.page import open_page
    from mstools.view.sources import open_live
    from mstools.view.viewer import Viewer

    source, page, stop = open_live(url, "", 1.0), open_page(port=0), threading.Event()
    viewer = Viewer(page, source)
    times: list[float] = []

    def is_stopped() -> bool:
        times.append(time.monotonic())
        return stop.is_set()

    thread = threading.Thread(target=viewer.run, args=(is_stopped,))
    thread.start()
    try:
        yield times, page.link
    finally:
        stop.set()
        thread.join()
        page.close()
        source.close()


def measure_latency(recorder: Recorder) -> float:
    """Return the median latency of a tick over the next seconds, milliseconds."""
    first = len(recorder.reports)
    time.sleep(SECONDS)
    return statistics.median(1e3 * each.tick_latency_p50 for each in recorder.reports[first:])


def main() -> int:
    try:
        import viser  # noqa: F401
    except ImportError:
        print("  skipped: the extra view is not installed")
        return SKIPPED
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "raptor"
        copytree(RAPTOR, folder)
        vehicle_file, log = folder / "vehicle.yaml", folder / "drive.lcm"
        vehicle_file.write_text(vehicle_file.read_text().replace("rate_hz: 50 #", f"rate_hz: {RATE_HZ} #"))
        url = free_url()
        recorder = Recorder(url, log)
        without, beside, cpu, pictures = [], [], [], []
        begin = time.monotonic()
        try:
            with run_process("-c", _RUN, "up", "-c", str(vehicle_file), "--emulate", "--url", url, url=url):
                time.sleep(START_S)
                for _ in range(ROUNDS):
                    own = time.process_time()
                    without.append(measure_latency(recorder))
                    own = time.process_time() - own
                    with run_viewer(url) as (times, _):
                        time.sleep(2.0)
                        drawn, used = len(times), time.process_time()
                        beside.append(measure_latency(recorder))
                        # without what the recorder takes in this process
                        cpu.append(100.0 * (time.process_time() - used - own) / SECONDS)
                        pictures.append(1e3 * SECONDS / (len(times) - drawn))
                shown = measure_page(url, own)
        finally:
            recorder.close()
        seconds = time.monotonic() - begin - START_S
        opened = measure_open(log) * 3600.0 / seconds
        size = log.stat().st_size / seconds * 3600.0 / 1e6
    print(f"  POSE at {RATE_HZ} Hz; latency of ticks without a viewer {statistics.median(without):.3f} ms, median")
    more = statistics.median(b - a for a, b in zip(without, beside, strict=True))
    print(f"  a log of an hour would have {size:.0f} MB")
    holds = [
        print_verdict("a picture each", statistics.median(pictures), PICTURES_BOUND, "ms"),
        print_verdict("processor time of the viewer", statistics.median(cpu), CPU_BOUND, "%"),
        print_verdict("median latency of ticks, more with a viewer", more, LATENCY_BOUND, "ms"),
        print_verdict("processor time to open an hour of log", opened, OPEN_BOUND, "s"),
    ]
    if shown is None:
        print("  processor time with a page that is open: skipped, no Chromium")
    else:
        holds.append(print_verdict("processor time with a page that is open", shown, CPU_BOUND, "%"))
    return 0 if all(holds) else 1


def measure_page(url: str, own: float) -> float | None:
    """Return the processor time of the viewer while a browser shows its page, percent of a core; None without one.

    `own` is what the rest of this process takes in `SECONDS`.
    """
    browser = next(filter(None, map(which, BROWSERS)), None)
    if browser is None:
        return None
    with run_viewer(url) as (_, link), tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = ("--headless=new", "--no-sandbox", "--window-size=1400,900", f"--user-data-dir={profile}")
        process = subprocess.Popen(
            [browser, *options, f"{link}#scene,map,plots"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            time.sleep(PAGE_S)
            used = time.process_time()
            time.sleep(SECONDS)
            return 100.0 * (time.process_time() - used - own) / SECONDS
        finally:
            process.kill()
            process.wait()


def measure_open(log: Path) -> float:
    """Return the processor time to open a log, seconds."""
    from mstools.view.sources import open_log

    begin = time.process_time()
    open_log(log)
    return time.process_time() - begin


if __name__ == "__main__":
    sys.exit(main())
