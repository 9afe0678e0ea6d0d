"""`modelserver demo`: the real daemon and the real drivers on loopback, with the Raptor's devices in software."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from modelserver.extras import describe_missing
from modelserver.messages import DriverHealth, DriverPhase, Invalid, PoseAnswer
from modelserver.transforms.pose import Pose
from modelserver.wire.provider import open_lcm, resolve_url
from mstools.commands.install import get_examples_folder
from mstools.commands.status import HealthListener
from mstools.launch.processes import (
    ChildProcesses,
    EmulatedConnections,
    LaunchError,
    get_start_utime,
    make_connections,
    start_devices,
    start_programs,
)
from mstools.terminal.options import option
from mstools.terminal.output import escape

SEED = 20050901
START_TIMEOUT_S = 20.0
"""Timeout for the first message of daemon and drivers, seconds."""
EXTRA_SECONDS = 60.0
"""Time that the devices run beyond the drive; the demo ends them earlier."""
LATE_SECONDS = 20.0
"""On a busy machine samples are late, and so is the heading."""
SETTLING_SECONDS = 2.0
"""Time from the start of the drive until a driver's rate is that of a whole second."""


def command(
    seconds: Annotated[float, option("--seconds S", "Duration of the drive.", min=7.0, max=600.0)] = 10.0,
    verbose: Annotated[bool, option("--verbose", "Show the logs of all processes.")] = False,
) -> None:
    """Run the whole service on emulated devices and show its answers: `modelserver up --emulate`, and queries.

    Starts the daemon for the report's Raptor, the drivers of its vehicle file, and an emulator for each device: GPS and
    IMU on pseudo-terminals, the vehicle's controller on a CAN bus over UDP, the nodding axis on Modbus/TCP, all on one
    simulated drive. Everything is on loopback, on ports of its own, so that a running vehicle is not disturbed. Queries
    poses, and prints the vehicle's pose beside the simulated truth. Ends by itself, or with Ctrl-C; exit code 1 if the
    pose never becomes valid, or a device does not report.

    Example: modelserver demo
    """
    with (
        tempfile.TemporaryDirectory(prefix="modelserver-demo-") as scratch,
        ChildProcesses((lambda name, text: typer.echo(f"{name}: {text}", err=True)) if verbose else None) as children,
    ):
        run_demo(make_connections(find_vehicle_file(), Path(scratch), own_bus=True), seconds, children)


def find_vehicle_file() -> Path:
    """Return the Raptor's vehicle file in the package."""
    return get_examples_folder() / "raptor" / "vehicle.yaml"


def run_demo(lines: EmulatedConnections, seconds: float, children: ChildProcesses) -> None:
    """Start all processes, query, and print. Raises LaunchError if something is missing."""
    typer.echo("1. Emulated devices, a process each, on one simulated drive")
    start_utime = get_start_utime(len(lines.devices))
    options = ("--seconds", f"{seconds + EXTRA_SECONDS:g}", "--seed", str(SEED))
    typer.echo("\n".join(map(escape, start_devices(children, lines, start_utime, options))))

    typer.echo(f"\n2. Daemon and drivers, a process each, for {find_vehicle_file()} with connections to these devices")
    commands = start_programs(children, lines.vehicle, lines.devices, ("--url", lines.url))
    typer.echo("\n".join(map(escape, commands)))
    # heavy imports, while the child processes load
    from modelserver.client.remote import Platform
    from modelserver.config.vehicle_file import load_config
    from mstools.commands.query import describe
    from mstools.launch.drive import make_simulation

    vehicle = load_config(lines.vehicle)
    prefix = vehicle.lcm.channel_prefix
    listener = PoseListener(lines.url, prefix)
    # a dozen processes on a busy machine: a reply may be late
    with Platform(lines.url, channel_prefix=prefix, name="demo", timeout=1.0, retries=9) as platform:
        wait_for_reports(listener, lines.devices, children)
        run = make_simulation(vehicle, start_utime, seconds + EXTRA_SECONDS)

        typer.echo("\n3. Queries of the geometry")
        typer.echo(f"bodies            {', '.join(platform.get_body_list())}")
        typer.echo(f"Digiclops has     {', '.join(platform.get_body_frame_list('Digiclops'))}")
        typer.echo(describe(platform.get_pose("Digiclops:ImagePlane", "FrontNoddingSICK:Origin")))

        typer.echo("\n4. POSE from GPS, IMU and wheels, beside the simulated truth")
        typer.echo("   time      easting     northing       up     yaw   error            protection level state")
        valid: list[PoseAnswer] = []
        received, next_row, alive = 0, 0.0, ""
        for pose in iter_poses(listener, start_utime, seconds, children, lambda: bool(valid)):
            received += 1
            since = (pose.transformation.utime - start_utime) * 1e-6
            is_first = pose.transformation.is_valid and not valid
            if pose.transformation.is_valid:
                valid.append(pose)
            if since >= next_row or is_first:
                truth = run.truth(pose.transformation.utime).utm
                typer.echo(format_row(pose, since, truth, run.geodesy.origin.initial_utm))
                next_row = math.floor(since) + 1.0
            if not alive and since >= SETTLING_SECONDS and not list_missing_devices(listener.drivers, lines):
                alive = ", ".join(f"{name} {listener.drivers[name].rate_hz:.1f} Hz" for name in lines.devices)
                typer.echo(f"   all {len(lines.devices)} devices are streaming: {alive}")
        if not alive:
            raise LaunchError(
                f"not all devices are streaming: {'; '.join(list_missing_devices(listener.drivers, lines))}"
            )
        if not valid:
            raise LaunchError(
                f"the pose never became valid in {seconds + LATE_SECONDS:g} s: {received} poses were received on POSE. "
                "Run it again with --verbose; a busy machine may need --seconds 20"
            )
        typer.echo(f"   {received} poses in {max(seconds, since):.0f} s, {len(valid)} of them valid")

        typer.echo("\n5. The camera in the world")
        typer.echo(describe(platform.get_pose("Digiclops:ImagePlane", "World:UTM")))
    typer.echo(f"\nDone. Next: modelserver run -c {find_vehicle_file()}, and in another shell: modelserver tree --live")
    if missing := describe_missing():
        typer.echo(missing)


class PoseListener(HealthListener):
    """Receive the poses, and the last health reports of the server and, by name, of the drivers."""

    def __init__(self, url: str, prefix: str):
        self.poses: list[PoseAnswer] = []
        super().__init__(open_lcm(resolve_url(url)), prefix, {"POSE": self.poses.append})
        for each in self.subscriptions:
            each.set_queue_capacity(0)


def wait_for_reports(listener: PoseListener, drivers: Iterable[str], children: ChildProcesses) -> None:
    """Wait for a health report of the daemon and of every driver. Raises LaunchError if one fails or takes too long."""

    def list_missing() -> list[str]:
        children.check()
        return ["daemon"] * (listener.health is None) + [name for name in drivers if name not in listener.drivers]

    if not listener.listen(START_TIMEOUT_S, lambda: not list_missing()):
        raise LaunchError(f"no report within {START_TIMEOUT_S:g} s of {', '.join(list_missing())}; see --verbose")


def list_missing_devices(drivers: dict[str, DriverHealth], lines: EmulatedConnections) -> list[str]:
    """List the devices that do not stream, with their status."""
    return [
        f"{name} is {drivers[name].phase.name.lower()} ({drivers[name].text})"
        for name in lines.devices
        if drivers[name].phase is not DriverPhase.STREAMING or not drivers[name].rate_hz
    ]


def iter_poses(
    listener: PoseListener, start_utime: int, seconds: float, children: ChildProcesses, has_valid: Callable[[], bool]
) -> Iterator[PoseAnswer]:
    """Yield the published poses of the drive; until one is valid also those of `LATE_SECONDS` after it."""
    end = time.monotonic() + start_utime * 1e-6 - time.time() + seconds
    while (left := end + (0.0 if has_valid() else LATE_SECONDS) - time.monotonic()) > 0.0:
        listener.listen(left, lambda: bool(listener.poses))
        yield from (pose for pose in listener.poses if pose.transformation.utime >= start_utime)
        listener.poses.clear()
        children.check()


def format_row(pose: PoseAnswer, since: float, truth: Pose, truth_origin: tuple[float, float, float]) -> str:
    """Format a row of the table: a pose, its error, and its protection levels."""
    found = pose.transformation
    state = format_validity(pose)
    position, heading = pose.horizontal_protection_level, pose.heading_protection_level
    if pose.origin is None or not math.isfinite(position):
        return f"{since:7.2f} s  {'-':>11} {'-':>12} {'-':>8} {'-':>7}   {'':16} {'':16} {state}"
    place = [a + b for a, b in zip(found.pose.xyz, pose.origin.initial_utm, strict=True)]
    real = [a + b for a, b in zip(truth.xyz, truth_origin, strict=True)]
    yaw = float(found.rpy[2])
    turned = math.degrees(math.remainder(yaw - float(truth.rpy[2]), math.tau))
    off = f"{math.hypot(place[0] - real[0], place[1] - real[1]):.2f} m {turned:+6.1f} deg"
    bound = f"{position:.2f} m {math.degrees(heading):6.1f} deg" if math.isfinite(heading) else "-"
    return (
        f"{since:7.2f} s {place[0]:12.2f} {place[1]:12.2f} {place[2]:8.2f} {round(math.degrees(yaw), 1) + 0.0:7.1f}   "
        f"{off:16} {bound:16} {state}"
    )


def format_validity(pose: PoseAnswer) -> str:
    """Format whether a pose is valid, with the first reason if not."""
    reasons = list(Invalid(pose.transformation.invalid_reasons))
    if not reasons:
        return "valid"
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return f"not valid: {reasons[0].explain()}{more}"
