"""CPU of each driver process at its nominal rate, percent of a core: real processes on pty, TCP, CAN and Modbus.

    python -m benchmarks driver_cpu

Each driver runs beside an emulator of its device for `SECONDS` after its first samples; the bus is loopback. CAN is
python-can's over UDP, which costs more than a socketcan interface.
"""

from __future__ import annotations

import contextlib
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import lcm

from benchmarks.support import MODELSERVER, RAPTOR, cpu_seconds, free_url, print_verdict, run_process
from modelserver.messages import DriverHealth
from modelserver.wire.codec import decode

SECONDS = 20.0
WARM_UP = 20
"""Samples before the measurement begins."""
TIMEOUT_S = 60.0
BOUND = 15.0
"""Percent of a core."""

GROUP = "239.74.163.3"
DRIVERS = """
drivers:
  novatel: {{device: novatel, port: {folder}/novatel, bauds: [38400], rate_hz: 20}}
  nmea: {{device: nmea, address: "127.0.0.1:{port}", rate_hz: 4}}
  gx1: {{device: gx1, port: {folder}/gx1}}
  wheels:
    device: wheels
    can: "{group}:{port}"
    interface: udp_multicast
    dbc: raptor.dbc
    wheels:
      front_left:
        count: {{signal: WheelCounts.FrontLeftCount, meters_per_count: 0.0125}}
        direction: {{signal: WheelCounts.FrontLeftDirection}}
      front_right:
        count: {{signal: WheelCounts.FrontRightCount, meters_per_count: 0.0125}}
        direction: {{signal: WheelCounts.FrontRightDirection}}
  vehicle:
    device: vehicle
    can: "{group}:{port}"
    interface: udp_multicast
    dbc: raptor.dbc
    status:
      mode: VehicleStatus.Mode
      modes: {{manual: 1, autonomous: 2}}
      forward_speed: {{signal: VehicleStatus.ForwardSpeed}}
  axis:
    device: axis
    address: "127.0.0.1:{port}"
    joint: nod
    poll_hz: 50
    registers:
      angle: {{address: 0, scale_deg: 0.01}}
"""

KINDS: dict[str, tuple[str, float]] = {
    "novatel": ("pty", 20.0),
    "nmea": ("tcp", 4.0),
    "gx1": ("pty", 100.0),
    "wheels": ("can", 100.0),
    "vehicle": ("can", 20.0),
    "axis": ("tcp", 50.0),
}
"""The line of each driver, and the samples a second that it is to bring."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextlib.contextmanager
def write_vehicle_file(port: int) -> Iterator[Path]:
    """Yield a vehicle file in a folder of its own."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file in ("vehicle.yaml", "geometry.yaml", "raptor.dbc"):
            shutil.copy(RAPTOR / file, folder)
        path = folder / "vehicle.yaml"
        # section drivers is the last one of the file
        rest, _, _ = path.read_text().partition("\ndrivers:")
        path.write_text(rest + DRIVERS.format(folder=folder, port=port, group=GROUP))
        yield path


def measure(name: str, line: str) -> tuple[float, float]:
    """Return a driver's CPU, percent of a core, and the samples per second that it published."""
    url, port = free_url(), free_port()
    reports: list[DriverHealth] = []
    bus = lcm.LCM(url)
    bus.subscribe("DRIVER_HEALTH", lambda _, data: reports.append(decode("driver_health_t", data)))

    def wait(enough: Callable[[], bool]) -> None:
        deadline = time.monotonic() + TIMEOUT_S
        while not enough():
            if time.monotonic() > deadline:
                raise RuntimeError(f"{name} does not stream: {reports[-1:]}")
            bus.handle_timeout(100)

    with write_vehicle_file(port) as path, contextlib.ExitStack() as stack:
        lines = {
            "pty": ("--pty", "--link", str(path.parent / name)),
            "tcp": ("--tcp", str(port)),
            "can": ("--can", f"{GROUP}:{port}"),
        }
        stack.enter_context(run_process("-c", MODELSERVER, "emulate", name, "-c", str(path), *lines[line], url=url))
        driver = stack.enter_context(run_process("-c", MODELSERVER, "driver", name, "-c", str(path), url=url))
        wait(lambda: bool(reports) and reports[-1].samples >= WARM_UP)
        first, begin, used = reports[-1], time.monotonic(), cpu_seconds(driver.pid)
        wait(lambda: time.monotonic() >= begin + SECONDS)
        used, spent = cpu_seconds(driver.pid) - used, time.monotonic() - begin
        last = reports[-1]
        rate = (last.samples - first.samples) / ((last.utime - first.utime) * 1e-6)
    return 100.0 * used / spent, rate


def main() -> int:
    holds = True
    for name, (line, nominal) in KINDS.items():
        percent, rate = measure(name, line)
        holds &= print_verdict(f"{name} on {line}, {rate:.1f} samples/s of {nominal:g}", percent, BOUND, "%")
        if abs(rate / nominal - 1.0) > 0.05:
            print(f"  {name} did not bring its nominal rate  <-- OUT OF BOUNDS")
            holds = False
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
