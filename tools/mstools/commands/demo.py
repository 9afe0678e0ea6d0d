"""`modelserver demo`: the real daemon and the real drivers on loopback, with the Raptor's devices in software."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from modelserver.errors import NoServerError, QueryError
from modelserver.messages import DriverHealth, DriverPhase, Health, Invalid, PoseAnswer
from modelserver.spatial.pose import Pose
from modelserver.wire.provider import open_lcm, resolve_url, take_message
from mstools.demo.children import MODELSERVER, Children, DemoError
from mstools.demo.lines import Lines, lay_lines
from mstools.deployment.place import examples

SEED = 20050901
LEAD_SECONDS = 1.5
LEAD_SHARE = 0.5
"""From starting the devices to the drive: so many seconds, and this share of what the processes before took to load,
which tells how slow the machine is. The vehicle stands at first: one that is ready a little later misses nothing."""
START_LIMIT = 20.0
"""How long daemon and drivers may take to be heard, seconds."""
OUTLIVE_SECONDS = 60.0
"""By which the devices would outlive the drive, had nobody ended them."""
SETTLED = 2.0
"""From the start of the drive to when a driver's rate is that of a whole second."""


def command(
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=7.0, max=600.0, help="How long to drive.")
    ] = 10.0,
    verbose: Annotated[bool, typer.Option("--verbose", help="Show the logs of all processes.")] = False,
) -> None:
    """Run the whole service on emulated devices and watch it answer.

    Starts the daemon for the report's Raptor, the drivers of its vehicle file, and for each the device in software: GPS
    and IMU on pseudo-terminals, the vehicle's controller on a CAN bus over UDP, the nodding axis on Modbus/TCP, all on
    one simulated drive. Everything is on loopback, on ports of its own, so that a running vehicle is not disturbed.
    Asks where things are, and prints the pose beside the simulated truth. Ends by itself, or with Ctrl-C; exit code 1
    where the pose never becomes valid, or a device is not heard.

    Example: modelserver demo
    """
    with (
        tempfile.TemporaryDirectory(prefix="modelserver-demo-") as scratch,
        Children(Path(scratch), verbose) as children,
    ):
        show(lay_lines(vehicle_file(), Path(scratch)), seconds, children)


def vehicle_file() -> Path:
    """Return the Raptor's vehicle file, which comes with the package. Raises DemoError."""
    file = examples() / "raptor" / "vehicle.yaml"
    if file.is_file():
        return file
    raise DemoError(f"{file} is missing: the installation is not whole; install ModelServer again")


def show(lines: Lines, seconds: float, children: Children) -> None:
    """Start everything, ask, and print. Raises DemoError where something is missing."""
    say = typer.echo
    config = str(lines.vehicle)
    say(f"1. The daemon and the drivers: a process each, on {vehicle_file()} with lines to emulated devices")
    begun = time.monotonic()
    for name, words in (("daemon", ("run",)), *((f"driver {name}", ("driver", name)) for name in lines.devices)):
        children.start(name, *MODELSERVER, *words, "-c", config, "--url", lines.url)
        say(f"modelserver {' '.join(words)} -c {config} --url '{lines.url}'")
    # heavy, so not before they are needed: `modelserver --help` lists this command too; and the others load meanwhile
    from modelserver.client.remote import Platform
    from modelserver.config import load_config
    from mstools.commands.query import describe
    from mstools.demo.drive import simulation

    vehicle = load_config(lines.vehicle)
    prefix = vehicle.lcm.channel_prefix
    ear = PoseListener(lines.url, prefix)
    with Platform(lines.url, channel_prefix=prefix, name="demo", timeout=0.25, retries=0) as platform:
        bodies = first_answer(platform.get_body_list, children)
        wait_for_drivers(ear, lines, children)
        # a dozen processes on a busy machine: an answer may take its time
        platform.timeout, platform.retries = 1.0, 9

        say("\n2. The devices, a process each; their drivers find them")
        took = time.monotonic() - begun
        start_utime = round((time.time() + LEAD_SECONDS + LEAD_SHARE * took) * 10) * 100_000
        together = ("--start", str(start_utime), "--seconds", f"{seconds + OUTLIVE_SECONDS:g}", "--seed", str(SEED))
        for name, line in lines.devices.items():
            children.start(f"device {name}", *MODELSERVER, "emulate", name, "-c", config, *line, *together)
            say(f"modelserver emulate {name} -c {config} {' '.join((*line, *together))}")
        run = simulation(vehicle, start_utime, seconds + OUTLIVE_SECONDS)

        say("\n3. What the daemon knows from the geometry file, asked from this process")
        say(f"bodies            {', '.join(bodies)}")
        say(f"Digiclops has     {', '.join(platform.get_body_frame_list('Digiclops'))}")
        say(describe(platform.get_pose("Digiclops:ImagePlane", "FrontNoddingSICK:Origin")))

        say("\n4. POSE, broadcast while GPS, IMU and wheels arrive from their drivers; the truth beside it")
        say("   time      easting     northing       up     yaw   off by           may be off by    state")
        valid: list[PoseAnswer] = []
        received = 0
        next_row = 0.0
        alive = ""
        for pose in poses(ear, start_utime, seconds, children):
            received += 1
            since = (pose.transformation.utime - start_utime) * 1e-6
            if pose.transformation.valid:
                valid.append(pose)
            if since >= next_row:
                say(row(pose, since, run.truth(pose.transformation.utime).utm, run.geodesy.origin.initial_utm))
                next_row = math.floor(since) + 1.0
            if not alive and since >= SETTLED and not missing(ear.health, lines):
                alive = ", ".join(f"{name} {ear.health[name].rate_hz:.1f} Hz" for name in lines.devices)
                say(f"   all {len(lines.devices)} devices are alive: {alive}")
        if not alive:
            raise DemoError(f"not all devices are alive: {'; '.join(missing(ear.health, lines))}")
        if not valid:
            raise DemoError(
                f"the pose never became valid in {seconds:g} s: {received} poses came on POSE. "
                "Run it again with --verbose; a busy machine may need --seconds 20"
            )
        say(f"   {received} poses in {seconds:g} s, {len(valid)} of them valid")
        for text in usage(ear.service):
            say(f"   {text}")

        say("\n5. Where was the camera in the world a second ago?")
        at = valid[-1].transformation.utime - 1_000_000
        say(describe(platform.get_pose("Digiclops:ImagePlane", "World:UTM", at=at)))
        history = platform.get_history(at - 1_000_000, at, 10.0)
        say(f"get_history gave {len(history)} poses of the second before that")
        say("\n6. The nodding laser a moment ago: where it was, and how it moved")
        at = valid[-1].transformation.utime - 200_000
        moving = platform.get_motion("FrontSICKLaser:Scan", "Raptor:CG", at=at)
        say(describe(moving.pose))
        say(f"  turns at        {math.degrees(-moving.rate[1]):.1f} deg/s, upwards positive")

        say("\n7. What it says to a slip")
        try:
            platform.get_transformation("Digiclop:ImagePlane", "Raptor:CG")
        except QueryError as error:
            say(f"{error}. Nearest: {', '.join(error.nearest)}")
    say(f"\nDone. Next: modelserver run -c {vehicle_file()}, and in another shell: modelserver bodies")


def usage(service: Health | None) -> list[str]:
    """Return for each sensor how many of its measurements localization used, and what it says of unusable ones.

    Raises DemoError where wheels were measured and none was used: the Raptor's front wheels steer, and must be used.
    """
    if service is None:
        raise DemoError("no health report came on MODELSERVER_HEALTH; run the demo with --verbose")
    counts = [
        (each.channel.removeprefix("sensor:"), each.used, each.measured) for each in service.channels if each.measured
    ]
    notices = [f"{subject}: {text}" for subject, text in service.notices if subject.startswith("sensor")]
    if any(name == "wheels" and not used for name, used, _ in counts):
        raise DemoError(f"no measurement of the wheels was used: {'; '.join(notices) or 'see --verbose'}")
    return [f"{name}: {used} of {measured} measurements used" for name, used, measured in counts] + notices


class PoseListener:
    """Receives the poses, and the health reports of the service and the drivers."""

    def __init__(self, url: str, prefix: str):
        from modelserver.wire.channels import literal
        from modelserver.wire.codec import decode

        self.poses: list[PoseAnswer] = []
        self.health: dict[str, DriverHealth] = {}
        """The last report of each driver by its name."""
        self.service: Health | None = None
        """The last report of the service."""
        self.bus = open_lcm(resolve_url(url))

        def report(_: str, data: bytes) -> None:
            health: DriverHealth = decode("driver_health_t", data)
            self.health[health.source] = health

        def service(_: str, data: bytes) -> None:
            self.service = decode("health_t", data)

        for channel, hear in (
            ("POSE", lambda _, data: self.poses.append(decode("pose_transform_t", data))),
            ("DRIVER_HEALTH", report),
            ("MODELSERVER_HEALTH", service),
        ):
            self.bus.subscribe(literal(f"{prefix}{channel}"), hear).set_queue_capacity(0)


def first_answer(ask: Callable[[], list[str]], children: Children) -> list[str]:
    """Ask until the daemon has come up. Raises DemoError where it fails or takes too long."""
    deadline = time.monotonic() + START_LIMIT
    while True:
        try:
            return ask()
        except NoServerError:
            children.check()
            if time.monotonic() > deadline:
                raise DemoError(
                    f"the daemon gave no answer within {START_LIMIT:g} s; run the demo with --verbose"
                ) from None


def wait_for_drivers(ear: PoseListener, lines: Lines, children: Children) -> None:
    """Wait until every driver has said how it is. Raises DemoError where one fails or takes too long."""
    deadline = time.monotonic() + START_LIMIT
    while unheard := [name for name in lines.devices if name not in ear.health]:
        take_message(ear.bus, 100)
        children.check()
        if time.monotonic() > deadline:
            raise DemoError(f"no word within {START_LIMIT:g} s of: driver {', '.join(unheard)}; see --verbose")


def missing(health: dict[str, DriverHealth], lines: Lines) -> list[str]:
    """Return in words which devices are not heard."""
    return [
        f"{name} is {health[name].phase.name.lower()} ({health[name].text})"
        for name in lines.devices
        if health[name].phase is not DriverPhase.STREAMING or not health[name].rate_hz
    ]


def poses(ear: PoseListener, start_utime: int, seconds: float, children: Children) -> Iterator[PoseAnswer]:
    """Yield what is broadcast from the start of the drive on, until its end."""
    end = time.monotonic() + start_utime * 1e-6 - time.time() + seconds
    while time.monotonic() < end:
        take_message(ear.bus, 100)
        yield from (pose for pose in ear.poses if pose.transformation.utime >= start_utime)
        ear.poses.clear()
        children.check()


def row(pose: PoseAnswer, since: float, truth: Pose, truth_origin: tuple[float, float, float]) -> str:
    """Return a line of the table: a pose, how far it is off the truth, and the bound it states."""
    found = pose.transformation
    if pose.origin is None or not math.isfinite(pose.horizontal_bound):
        return f"{since:7.2f} s  {'-':>11} {'-':>12} {'-':>8} {'-':>7}   {'':16} {'':16} {why_not(pose)}"
    place = [a + b for a, b in zip(found.pose.xyz, pose.origin.initial_utm, strict=True)]
    real = [a + b for a, b in zip(truth.xyz, truth_origin, strict=True)]
    yaw = float(found.rpy[2])
    turned = math.degrees(math.remainder(yaw - float(truth.rpy[2]), math.tau))
    off = f"{math.hypot(place[0] - real[0], place[1] - real[1]):.2f} m {turned:+6.1f} deg"
    bound = "-"
    if math.isfinite(pose.horizontal_bound) and math.isfinite(pose.heading_bound):
        bound = f"{pose.horizontal_bound:.2f} m {math.degrees(pose.heading_bound):6.1f} deg"
    return (
        f"{since:7.2f} s {place[0]:12.2f} {place[1]:12.2f} {place[2]:8.2f} {round(math.degrees(yaw), 1) + 0.0:7.1f}   "
        f"{off:16} {bound:16} {why_not(pose)}"
    )


def why_not(pose: PoseAnswer) -> str:
    """Return whether a pose is valid, and the first reason why not."""
    reasons = list(Invalid(pose.transformation.invalid_reasons))
    if not reasons:
        return "valid"
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    return f"not valid: {reasons[0].explain()}{more}"
