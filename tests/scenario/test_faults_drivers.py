"""Every driver of the Raptor killed and hung, beside the real daemon; the devices are in software."""

from __future__ import annotations

import signal
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import lcm
from support_daemon import RESTART_SEC, START_S, Trial
from support_lcm import MODELSERVER, started
from support_ride import RAPTOR, Ride

from modelserver.config import load_config
from modelserver.messages import DriverHealth, DriverPhase
from modelserver.wire.codec import decode
from mstools.demo.drive import simulation
from mstools.demo.lines import lay_lines

CHANNELS = {"gps": "GPS", "imu": "IMU", "wheels": "WHEELS", "raptor": "VEHICLE_STATUS", "front_axis": "JOINTS"}
LOCALIZING = ("gps", "imu", "wheels")
SECONDS, SEED = 120.0, 3


class Drivers:
    """The drivers' processes, what they say of themselves, and when each last told of its device."""

    def __init__(self, run: Trial, folder: Path, stack: ExitStack):
        self._run, self._folder, self._stack = run, folder, stack
        self.processes: dict[str, subprocess.Popen[str]] = {}
        self.health: dict[str, DriverHealth] = {}
        self.heard: dict[str, float] = {}
        self.bus = lcm.LCM(run.url)
        self.bus.subscribe("DRIVER_HEALTH", self._report).set_queue_capacity(0)
        for name, channel in CHANNELS.items():
            self.bus.subscribe(channel, lambda _, data, name=name: self.heard.__setitem__(name, time.monotonic()))

    def _report(self, channel: str, data: bytes) -> None:
        health = decode("driver_health_t", data)
        self.health[health.source] = health

    def listen(self) -> None:
        while not self._run.ended:
            self.bus.handle_timeout(100)

    def start(self, name: str) -> None:
        log = self._stack.enter_context((self._folder / f"driver_{name}.log").open("a"))
        command = (*MODELSERVER, "driver", name, "-c", str(self._run.vehicle))
        self.processes[name] = self._stack.enter_context(started(command, self._run.url, stderr=log))

    def streaming(self, name: str, since: float) -> bool:
        return self.heard.get(name, 0.0) > since and self.health[name].phase is DriverPhase.STREAMING


def test_given_each_driver_killed_and_hung_then_it_streams_again_and_the_pose_is_right_or_says_that_it_is_not(
    tmp_path: Path,
) -> None:
    lines = lay_lines(RAPTOR / "vehicle.yaml", tmp_path)
    with ExitStack() as stack:
        run = Trial(lines.url, tmp_path, Ride.at(0, 1.0), lines.vehicle)
        stack.callback(run.close)
        drivers = Drivers(run, tmp_path, stack)
        run.open()
        run.spawn(drivers.listen)
        begun = run.start()
        for name in lines.devices:
            drivers.start(name)
        run.until(lambda: drivers.health.keys() >= lines.devices.keys(), "a report of each driver", START_S)
        start_utime = round(time.time() + 2.0) * 1_000_000
        together = ("--start", str(start_utime), "--seconds", f"{SECONDS:g}", "--seed", str(SEED))
        for name, line in lines.devices.items():
            command = (*MODELSERVER, "emulate", name, "-c", str(lines.vehicle), *line, *together)
            stack.enter_context(started(command, run.url, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        run.ride = Ride(start_utime, SECONDS, simulation(load_config(lines.vehicle), start_utime, SECONDS))
        run.until(lambda: run.valid_since(begun), "a valid pose")

        told = {}
        for name in lines.devices:
            drivers.processes[name].kill()
            killed = time.monotonic()
            drivers.processes[name].wait()
            time.sleep(RESTART_SEC)
            drivers.start(name)
            streaming = run.until(lambda name=name, at=killed + RESTART_SEC: drivers.streaming(name, at), name)
            told[name] = streaming - killed
            run.until(lambda at=killed: run.answered_since(at), "an answer")
        for name, process in drivers.processes.items():
            process.send_signal(signal.SIGSTOP)
            hung = time.monotonic()
            time.sleep(0.7)
            assert drivers.heard[name] < hung + 0.5
            process.send_signal(signal.SIGCONT)
            run.until(lambda name=name, at=hung + 0.7: drivers.streaming(name, at), name)
        since = time.monotonic()
        run.until(lambda: run.valid_since(since), "a valid pose")
        found = run.assert_right()
        assert run.health.handler_errors == 0
        print({name: f"{seconds:.2f} s" for name, seconds in told.items()}, f"{len(found)} poses")
