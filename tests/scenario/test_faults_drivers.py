"""Every driver of the Raptor killed and hung, beside the real daemon; the devices are in software."""

from __future__ import annotations

import signal
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import lcm
from support_command import run_command
from support_daemon import RESTART_SEC, START_TIMEOUT_S, Trial
from support_drive import RAPTOR, SimulatedDrive

from modelserver.config.vehicle_file import load_config
from modelserver.messages import DriverHealth, DriverPhase
from modelserver.wire.codec import decode
from mstools.launch.drive import make_simulation
from mstools.launch.processes import make_connections

CHANNELS = {"gps": "GPS", "imu": "IMU", "wheels": "WHEELS", "raptor": "VEHICLE_STATUS", "front_axis": "JOINTS"}
LOCALIZING = ("gps", "imu", "wheels")
SECONDS, SEED = 120.0, 3


class Drivers:
    """The drivers' processes, their health reports, and when each last published a sample."""

    def __init__(self, run: Trial, folder: Path, stack: ExitStack):
        self._run, self._folder, self._stack = run, folder, stack
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self.health: dict[str, DriverHealth] = {}
        self.received_at: dict[str, float] = {}
        self.bus = lcm.LCM(run.url)
        self.bus.subscribe("DRIVER_HEALTH", self._report).set_queue_capacity(0)
        for name, channel in CHANNELS.items():
            self.bus.subscribe(channel, lambda _, data, name=name: self.received_at.__setitem__(name, time.monotonic()))

    def _report(self, channel: str, data: bytes) -> None:
        health = decode("driver_health_t", data)
        self.health[health.source] = health

    def listen(self) -> None:
        while not self._run.is_stopped:
            self.bus.handle_timeout(100)

    def start(self, name: str) -> None:
        log = self._stack.enter_context((self._folder / f"driver_{name}.log").open("a"))
        words = ("driver", name, "-c", str(self._run.vehicle))
        self.processes[name] = self._stack.enter_context(run_command(words, self._run.url, stderr=log))

    def is_streaming(self, name: str, since: float) -> bool:
        return self.received_at.get(name, 0.0) > since and self.health[name].phase is DriverPhase.STREAMING


def test_given_each_driver_killed_and_hung_then_it_streams_again_and_the_pose_is_right_or_invalid(
    tmp_path: Path,
) -> None:
    lines = make_connections(RAPTOR / "vehicle.yaml", tmp_path, own_bus=True)
    with ExitStack() as stack:
        run = Trial(lines.url, tmp_path, SimulatedDrive.create(0, 1.0), lines.vehicle)
        stack.callback(run.close)
        drivers = Drivers(run, tmp_path, stack)
        run.open()
        run.spawn(drivers.listen)
        started = run.start()
        for name in lines.devices:
            drivers.start(name)
        run.wait_until(
            lambda: drivers.health.keys() >= lines.devices.keys(), "a report of each driver", START_TIMEOUT_S
        )
        start_utime = round(time.time() + 2.0) * 1_000_000
        together = ("--start", str(start_utime), "--seconds", f"{SECONDS:g}", "--seed", str(SEED))
        for name, line in lines.devices.items():
            words = ("emulate", name, "-c", str(lines.vehicle), *line, *together)
            stack.enter_context(run_command(words, run.url, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        run.ride = SimulatedDrive(
            start_utime, SECONDS, make_simulation(load_config(lines.vehicle), start_utime, SECONDS)
        )
        run.wait_until(lambda: run.is_valid_since(started), "a valid pose")

        recovery = {}
        for name in lines.devices:
            drivers.processes[name].kill()
            killed = time.monotonic()
            drivers.processes[name].wait()
            time.sleep(RESTART_SEC)
            drivers.start(name)
            streaming = run.wait_until(lambda name=name, at=killed + RESTART_SEC: drivers.is_streaming(name, at), name)
            recovery[name] = streaming - killed
            run.wait_until(lambda at=killed: run.is_answered_since(at), "an answer")
        for name, process in drivers.processes.items():
            process.send_signal(signal.SIGSTOP)
            hung = time.monotonic()
            time.sleep(0.7)
            assert drivers.received_at[name] < hung + 0.5
            process.send_signal(signal.SIGCONT)
            run.wait_until(lambda name=name, at=hung + 0.7: drivers.is_streaming(name, at), name)
        since = time.monotonic()
        run.wait_until(lambda: run.is_valid_since(since), "a valid pose")
        found = run.assert_consistent()
        assert run.health.handler_errors == 0
        print({name: f"{seconds:.2f} s" for name, seconds in recovery.items()}, f"{len(found)} poses")
