"""Drivers and emulated devices as processes of their own, on real lines: pty, TCP, CAN over UDP, Modbus/TCP."""

from __future__ import annotations

import itertools
import random
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lcm
import pytest
from support_command import run_command
from support_lcm import TIMEOUT_S, invoke, reserved_url, wait_until

from modelserver.messages import DriverHealth, DriverPhase, VehicleCommand
from modelserver.wire.codec import decode, encode
from msdrivers.links.can_bus import CanLink

ROOT = Path(__file__).parents[2]

DRIVERS = """
drivers:
  gps: {{device: novatel, port: {folder}/gps, bauds: [38400], rate_hz: 20}}
  nmea: {{device: nmea, address: "127.0.0.1:{port}", rate_hz: 4}}
  ublox: {{device: ublox, port: {folder}/ublox, rate_hz: 10}}
  gpsd: {{device: gpsd, address: "127.0.0.1:{gpsd_port}"}}
  imu: {{device: gx1, port: {folder}/imu}}
  vectornav: {{device: vectornav, port: {folder}/vectornav, rate_hz: 100}}
  xsens: {{device: xsens, port: {folder}/xsens, rate_hz: 100}}
  text_imu:
    device: text_imu
    port: {folder}/text_imu
    baud: 115200
    columns: 7
    fields:
      time: {{column: 0, scale: 0.001}}
      specific_force_x: {{column: 1, scale: 9.80665}}
      specific_force_y: {{column: 2, scale: 9.80665}}
      specific_force_z: {{column: 3, scale: 9.80665}}
      angular_velocity_x: {{column: 4, scale: 0.0174533}}
      angular_velocity_y: {{column: 5, scale: 0.0174533}}
      angular_velocity_z: {{column: 6, scale: 0.0174533}}
  head:
    device: text_joints
    port: {folder}/head
    baud: 57600
    columns: 1
    joints:
      nod: {{column: 0, scale: 0.0174533}}
  wheels:
    device: wheels
    can: "239.74.163.2:{port}"
    interface: udp_multicast
    dbc: raptor.dbc
    wheels:
      front_left:
        count: {{signal: WheelCounts.FrontLeftCount, meters_per_count: 0.0125}}
        direction: {{signal: WheelCounts.FrontLeftDirection}}
        is_steered: true
      front_right:
        count: {{signal: WheelCounts.FrontRightCount, meters_per_count: 0.0125}}
        direction: {{signal: WheelCounts.FrontRightDirection}}
        is_steered: true
  axis:
    device: axis
    address: "127.0.0.1:{axis_port}"
    joint: nod
    registers:
      angle: {{address: 0, scale_deg: 0.01}}
    poll_hz: 50
  raptor:
    device: vehicle
    can: "239.74.163.2:{port}"
    interface: udp_multicast
    dbc: raptor.dbc
    limits: {{forward_speed: 3.0}}
    dead_man: 0.4
    status:
      mode: VehicleStatus.Mode
      modes: {{manual: 1, autonomous: 2, emergency_stop: 3, fault: 4}}
      commands_rejected: VehicleStatus.CommandsRefused
      forward_speed: {{signal: VehicleStatus.ForwardSpeed}}
      steering_angle: {{signal: VehicleStatus.SteeringAngle, scale: 0.0174533}}
    command:
      forward_speed: {{signal: VehicleCommand.ForwardSpeed}}
      steering_angle: {{signal: VehicleCommand.SteeringAngle, scale: 0.0174533}}
      alive: VehicleCommand.Alive
      drive_signals: {{Enable: 1}}
      stop_signals: {{Enable: 0}}
"""

CHANNELS = {
    "gps": ("GPS", "gps_t"),
    "nmea": ("GPS", "gps_t"),
    "ublox": ("GPS", "gps_t"),
    "gpsd": ("GPS", "gps_t"),
    "imu": ("IMU", "imu_t"),
    "vectornav": ("IMU", "imu_t"),
    "xsens": ("IMU", "imu_t"),
    "text_imu": ("IMU", "imu_t"),
    "head": ("JOINTS", "joints_t"),
    "wheels": ("WHEELS", "wheels_t"),
    "axis": ("JOINTS", "joints_t"),
    "raptor": ("VEHICLE_STATUS", "vehicle_status_t"),
}

RATES_HZ = {
    "gps": 20, "nmea": 4, "ublox": 10, "gpsd": 4, "imu": 100, "vectornav": 100, "xsens": 100, "text_imu": 100,
    "wheels": 100, "axis": 50, "head": 50,
}  # fmt: skip
"""Rate of each device, as it is configured or emulated."""

GROUPS = (("gps", "nmea", "imu", "wheels", "axis"), ("ublox", "gpsd", "vectornav", "xsens", "text_imu", "head"))
"""Devices that are unplugged together: each waits as long."""

UNPLUGGED_S, BACK_S = 5.0, 2.0
WHEEL_COUNTS = 256
"""CAN identifier of the wheel counts."""


@dataclass
class Bench:
    """A vehicle file, a bus, and the messages received on it."""

    folder: Path
    url: str
    port: int
    axis_port: int
    gpsd_port: int
    samples: list[Any] = field(default_factory=list)
    received_at: list[float] = field(default_factory=list)
    """When each sample was received, seconds of the monotonic clock."""
    counts: Counter[str] = field(default_factory=Counter)
    """Samples of each driver."""
    reports: list[DriverHealth] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name in ("vehicle.yaml", "geometry.yaml", "raptor.dbc"):
            shutil.copy(ROOT / "config" / "raptor" / name, self.folder)
        # the drivers of the trial in place of the vehicle's own, which come last
        rest, _, _ = self.vehicle.read_text().partition("\ndrivers:")
        self.vehicle.write_text(rest + DRIVERS.format(**vars(self)))
        self.bus = lcm.LCM(self.url)
        reports = self.bus.subscribe(
            "DRIVER_HEALTH", lambda _, data: self.reports.append(decode("driver_health_t", data))
        )
        reports.set_queue_capacity(0)

    @property
    def vehicle(self) -> Path:
        return self.folder / "vehicle.yaml"

    def subscribe(self, name: str) -> None:
        self.subscribe_channel(*CHANNELS[name])

    def subscribe_channel(self, channel: str, type_name: str) -> None:
        def handle(_: str, data: bytes) -> None:
            self.received_at.append(time.monotonic())
            self.samples.append(decode(type_name, data))
            self.counts[self.samples[-1].header.source] += 1

        self.bus.subscribe(channel, handle).set_queue_capacity(0)

    def samples_of(self, name: str) -> list[tuple[float, Any]]:
        """Return the samples of a driver, each with when it was received."""
        rows = zip(self.received_at, self.samples, strict=True)
        return [row for row in rows if row[1].header.source == name]

    def wait(self, arrived: Callable[[], bool], what: str) -> None:
        if not wait_until(self.bus, arrived, TIMEOUT_S):
            output = "".join(f"\n{log.name}:\n{log.read_text()}" for log in sorted(self.folder.glob("*.log")))
            pytest.fail(f"{what} did not come; {self.reports[-1:]}{output}")

    def elapse(self, seconds: float) -> None:
        wait_until(self.bus, lambda: False, seconds)

    def phase(self) -> DriverPhase | None:
        return self.reports[-1].phase if self.reports else None

    @contextmanager
    def driver(self, name: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
        with (
            (self.folder / "driver.log").open("a") as log,
            run_command(("driver", name, "-c", self.vehicle, *arguments), self.url, stderr=log) as process,
        ):
            yield process

    @contextmanager
    def device(self, name: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
        """Run an emulator; the block begins when its line is open."""
        pty = ("--pty", "--link", self.folder / name)
        lines = {
            "nmea": ("--tcp", str(self.port)),
            "axis": ("--tcp", str(self.axis_port)),
            "gpsd": ("--tcp", str(self.gpsd_port)),
            "wheels": ("--can", f"239.74.163.2:{self.port}"),
            "raptor": ("--can", f"239.74.163.2:{self.port}"),
        }
        words = ("emulate", name, "-c", self.vehicle, *lines.get(name, pty), *arguments)
        with (
            (self.folder / "device.log").open("a") as log,
            run_command(words, self.url, stderr=log, stdout=subprocess.PIPE) as process,
        ):
            assert process.stdout is not None
            with process.stdout:
                assert " is on " in process.stdout.readline(), (self.folder / "device.log").read_text()
                yield process


@contextmanager
def reserved_port() -> Iterator[int]:
    """Yield a port that no other test listens on: who has an even one holds the odd one above it.

    They lie below those of `reserved_url`, and below those that the kernel hands out by itself.
    """
    for port in random.SystemRandom().sample(range(12_000, 20_000, 2), 100):
        with socket.socket() as holder, socket.socket() as probe:
            try:
                holder.bind(("127.0.0.1", port + 1))
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            probe.close()
            yield port
            return
    raise RuntimeError("no free port")


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with reserved_url() as url, reserved_port() as port, reserved_port() as axis_port, reserved_port() as gpsd_port:
        yield Bench(tmp_path, url, port, axis_port, gpsd_port)


@contextmanager
def counted_frames(bench: Bench) -> Iterator[list[float]]:
    """Yield the receive times of the wheel frames on the CAN bus, seconds of the monotonic clock."""
    frames: list[float] = []
    ending = threading.Event()
    link = CanLink(f"239.74.163.2:{bench.port}", "udp_multicast")
    link.open()

    def count() -> None:
        while not ending.is_set():
            now = time.monotonic()
            frames.extend(now for frame in link.poll(0.1) if frame.arbitration_id == WHEEL_COUNTS)

    thread = threading.Thread(target=count)
    thread.start()
    try:
        yield frames
    finally:
        ending.set()
        thread.join()
        link.close()


@pytest.mark.parametrize("names", GROUPS, ids="-".join)
def test_given_devices_unplugged_for_5_s_then_they_stream_within_2_s_of_their_return_and_nothing_is_lost(
    bench: Bench, names: tuple[str, ...]
) -> None:
    for channel in {CHANNELS[name] for name in names}:
        bench.subscribe_channel(*channel)

    def have_all(more: Mapping[str, int] | None = None) -> bool:
        """Return whether there are samples of two seconds, and the first ones, of each device, since so many."""
        enough = {name: round(2.0 * RATES_HZ[name]) + 8 for name in names}
        return all(bench.counts[name] >= enough[name] + (more or {}).get(name, 0) for name in names)

    def are_streaming() -> bool:
        last = {report.source: report.phase for report in bench.reports}
        return all(last.get(name) is DriverPhase.STREAMING for name in names)

    with ExitStack() as stack:
        frames = stack.enter_context(counted_frames(bench)) if "wheels" in names else None
        drivers = [stack.enter_context(bench.driver(name)) for name in names]
        bench.wait(lambda: {each.source for each in bench.reports} == set(names), "a report without a device")
        with ExitStack() as plugged:
            devices = [plugged.enter_context(bench.device(name)) for name in names]
            bench.wait(have_all, "samples")
            bench.wait(are_streaming, "streaming")
            for name, device in zip(names, devices, strict=True):
                device.kill()
                device.wait(TIMEOUT_S)
                # as the system does with the name of an unplugged adapter
                (bench.folder / name).unlink(missing_ok=True)
        bench.elapse(UNPLUGGED_S)
        before = {name: len(bench.samples_of(name)) for name in names}
        last = {report.source: report.phase for report in bench.reports}
        assert set(last.values()) <= {DriverPhase.CLOSED, DriverPhase.SILENT}
        with ExitStack() as plugged:
            for name in names:
                plugged.enter_context(bench.device(name))
            # all of them: their programs load at the same time
            back = time.monotonic()
            bench.wait(lambda: have_all(before), "samples after their return")
            bench.wait(are_streaming, "streaming after their return")
        if frames is not None:
            wheels = bench.samples_of("wheels")
            bench.wait(lambda: bench.counts["wheels"] >= len(frames), f"a sample for {len(frames)} frames")
            assert len(bench.samples_of("wheels")) == len(frames), len(wheels)
        for driver in drivers:
            driver.send_signal(signal.SIGTERM)
        assert [driver.wait(TIMEOUT_S) for driver in drivers] == [0] * len(names)
    bench.wait(lambda: sum(each.text == "ended" for each in bench.reports) == len(names), "the last reports")
    for name in names:
        samples = bench.samples_of(name)
        (health,) = (each for each in bench.reports if (each.source, each.text) == (name, "ended"))
        assert health.samples == len(samples)
        sequence = [sample.header.seq for _, sample in samples]
        assert sequence == list(range(sequence[0], sequence[0] + len(sequence)))
        assert samples[before[name]][0] - back < BACK_S, name
        for _, sample in samples:
            assert 0 <= sample.header.host_utime - sample.header.utime < 1_000_000
        for run in (samples[8 : before[name]], samples[before[name] + 8 :]):
            check_steps(name, [sample for _, sample in run])


def check_steps(name: str, samples: list[Any]) -> None:
    """Check that none is doubled or left out, by the device's own time, where it has one.

    By the host's clock a busy machine leaves out what it had no time for: axis and head have only that. The axis driver
    has its rate with a clock of its tests.
    """
    times = [sample.header.device_utime for sample in samples]
    if times[0]:
        steps = [after - before for before, after in itertools.pairwise(times)]
        assert steps == pytest.approx([1_000_000 / RATES_HZ[name]] * len(steps), abs=2)


def test_given_a_stall_and_damage_then_the_driver_reports_and_recovers(bench: Bench) -> None:
    bench.subscribe("imu")
    with bench.driver("imu"), bench.device("imu", "--fault", "corrupt@3:5", "--fault", "stall@4:1.5"):
        bench.wait(lambda: bool(bench.samples), "samples")
        bench.wait(lambda: any(report.phase is DriverPhase.SILENT for report in bench.reports), "silence")
        silent = len(bench.samples)
        bench.wait(lambda: len(bench.samples) > silent + 5, "samples after the stall")


def test_given_a_raw_recording_when_played_then_the_same_is_measured_without_the_device(bench: Bench) -> None:
    bench.subscribe("gps")
    raw = bench.folder / "gps.raw"
    with bench.device("gps"), bench.driver("gps", "--record-raw", str(raw)) as driver:
        bench.wait(lambda: len(bench.samples) >= 4, "samples")
        driver.send_signal(signal.SIGTERM)
        assert driver.wait(TIMEOUT_S) == 0
    # all its messages have been received once its last report has
    bench.wait(lambda: bool(bench.reports) and bench.reports[-1].text == "ended", "the last report")
    first = list(bench.samples)
    bench.samples.clear()
    with bench.driver("gps", "--play-raw", str(raw)) as driver:
        assert driver.wait(TIMEOUT_S) == 0
    bench.wait(lambda: len(bench.samples) >= 4, "samples of the recording")
    measured = [(each.latitude_deg, each.longitude_deg, each.height_ellipsoidal) for each in first]
    again = [(each.latitude_deg, each.longitude_deg, each.height_ellipsoidal) for each in bench.samples]
    assert again[:4] == measured[:4]


@pytest.mark.parametrize(
    ("name", "fault", "text"),
    [
        ("wheels", "bus_off@2:1", "went bus-off"),
        ("raptor", "stall@2:2", "no usable VehicleStatus"),
        ("axis", "exception@2:4", "exception 4"),
    ],
)
def test_given_a_fault_of_the_devices_own_kind_then_the_driver_reports_it_and_recovers(
    bench: Bench, name: str, fault: str, text: str
) -> None:
    bench.subscribe(name)
    with bench.driver(name):
        bench.wait(lambda: bool(bench.reports), "a report without a device")
        with bench.device(name, "--fault", fault):
            bench.wait(lambda: len(bench.samples) > 5, "samples")
            # it was silent before there was a device, too
            bench.reports.clear()
            bench.wait(lambda: any(text in report.text for report in bench.reports), text)
            count_before = len(bench.samples)
            bench.wait(lambda: len(bench.samples) > count_before + 5, "samples after the fault")
            bench.wait(lambda: bench.phase() is DriverPhase.STREAMING, "streaming after the fault")


def test_given_commands_then_the_vehicle_drives_and_when_they_cease_it_stops(bench: Bench) -> None:
    bench.subscribe("raptor")
    seq = itertools.count(1)
    sent = [0.0]

    def command() -> None:
        if time.monotonic() - sent[0] >= 0.1:
            sent[0] = time.monotonic()
            command_message = VehicleCommand(time.time_ns() // 1000, 0.3, next(seq), "operator", 1.0, 0.1)
            bench.bus.publish("VEHICLE_COMMAND", encode(command_message))

    def drives() -> bool:
        command()
        return bool(bench.samples) and bench.samples[-1].forward_speed > 0.95

    with bench.device("raptor"), bench.driver("raptor"):
        bench.wait(lambda: bool(bench.samples), "a status")
        assert bench.samples[-1].forward_speed == 0.0
        bench.wait(drives, "the speed that was commanded")
        assert bench.samples[-1].steering_angle == pytest.approx(0.1, abs=0.01)
        bench.wait(lambda: bench.samples[-1].forward_speed == 0.0, "a stop")
        # 0.3 s that the command holds, 0.33 s to brake, and what a loaded machine takes
        assert bench.received_at[-1] - sent[0] < 2.0
        assert bench.samples[-1].commands_rejected == 0
        bench.wait(lambda: any("'operator': stop" in report.text for report in bench.reports), "word of the stop")
        bench.wait(lambda: dict(bench.reports[-1].counters).get("dead_man") == 1, "its count")


def test_given_mistyped_names_then_the_nearest_is_reported(bench: Bench) -> None:
    wrong = invoke(bench.url, "driver", "gsp", "-c", bench.vehicle)
    assert wrong.returncode == 2
    assert "did you mean gps?" in wrong.stderr
    fault = invoke(bench.url, "emulate", "gps", "-c", bench.vehicle, "--pty", "--fault", "stal@1")
    assert fault.returncode == 2
    assert "did you mean stall?" in fault.stderr
    text = bench.vehicle.read_text().replace("bauds: [38400]", "buads: [38400]")
    bench.vehicle.write_text(text)
    for command in (("driver", "gps", "-c"), ("check",)):
        slip = invoke(bench.url, *command, bench.vehicle)
        assert slip.returncode == 1
        output = slip.stderr + slip.stdout
        assert "unknown key 'buads'" in output
        assert "write bauds" in output


def test_given_list_then_ports_are_shown(bench: Bench) -> None:
    shown = invoke(bench.url, "driver", "--list")
    assert shown.returncode == 0, shown.stderr
    assert "serial port" in shown.stdout or "/dev/" in shown.stdout


def test_given_a_port_in_use_then_the_emulator_reports_it(bench: Bench) -> None:
    with bench.device("nmea"):
        second = invoke(bench.url, "emulate", "nmea", "-c", bench.vehicle, "--tcp", str(bench.port))
    assert second.returncode == 1
    assert f"port {bench.port} is in use" in second.stderr
