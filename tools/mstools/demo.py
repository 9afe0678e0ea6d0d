"""`modelserver demo`: the real daemon on loopback, with the Raptor and simulated sensors; watch it answer."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from types import FrameType
from typing import IO, Annotated

import typer

from modelserver.errors import ModelServerError, NoServerError, QueryError
from modelserver.messages import Invalid, PoseAnswer
from modelserver.spatial.pose import Pose

SEED = 20050901
LEAD_SECONDS = 1.5
"""From starting the sensors to their first sample: the time that process needs to load."""
START_LIMIT = 10.0
"""How long the daemon may take to answer, seconds."""
STOP_LIMIT = 3.0
"""How long a child may take to end after SIGTERM, seconds."""


class DemoError(ModelServerError):
    """The demo did not show what it should; the message says what was missing."""


def command(
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", min=7.0, max=600.0, help="How long to drive.")
    ] = 10.0,
    verbose: Annotated[bool, typer.Option("--verbose", help="Show the daemon's log.")] = False,
) -> None:
    """Run the whole service on simulated sensors and watch it answer.

    Starts the daemon for the report's Raptor on loopback, on a port of its own so that a running vehicle is not
    disturbed, and a second process that publishes a simulated GPS, IMU and wheels; asks where things are, and prints
    the pose beside the simulated truth. Ends by itself; exit code 1 where the pose never becomes valid.

    Example: modelserver demo
    """
    config = vehicle_file()
    url = f"udpm://239.255.76.67:{free_port()}?ttl=0"
    with (
        tempfile.TemporaryDirectory(prefix="modelserver-demo-") as scratch,
        Children(Path(scratch), verbose) as children,
    ):
        show(config, url, seconds, children)


def vehicle_file() -> Path:
    """Return the Raptor's vehicle file: of the source tree, or as it was installed. Raises DemoError."""
    places = [
        Path(__file__).resolve().parents[2] / "config",
        Path(str(files("modelserver"))) / "share" / "config",
    ]
    for place in places:
        file = place / "raptor" / "vehicle.yaml"
        if file.is_file():
            return file
    raise DemoError(f"config/raptor/vehicle.yaml is missing; looked in {', '.join(map(str, places))}. Install it anew.")


def free_port() -> int:
    """Return a UDP port that nobody uses, so that two demos, or a demo and a vehicle, do not hear each other."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass(slots=True)
class Child:
    """A process that the demo started, and the file its errors go to."""

    what: str
    process: subprocess.Popen[bytes]
    errors: Path


class Children:
    """The processes of the demo. Leaving the block ends them, whatever happened in it, SIGTERM included."""

    def __init__(self, scratch: Path, verbose: bool):
        self._scratch = scratch
        self._verbose = verbose
        self._started: list[Child] = []
        self._before: Callable[[int, FrameType | None], object] | int | None = None

    def __enter__(self) -> Children:
        def ended(number: int, frame: FrameType | None) -> None:
            raise SystemExit(128 + number)

        self._before = signal.signal(signal.SIGTERM, ended)
        return self

    def __exit__(self, *_: object) -> None:
        # a second Ctrl-C must not leave them behind
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            for child in self._started:
                child.process.terminate()
            deadline = time.monotonic() + STOP_LIMIT
            for child in self._started:
                try:
                    child.process.wait(max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    child.process.kill()
                    child.process.wait()
        finally:
            signal.signal(signal.SIGINT, before)
            signal.signal(signal.SIGTERM, self._before)

    def start(self, what: str, *arguments: str) -> None:
        """Start a Python process with these arguments."""
        errors = self._scratch / f"{len(self._started)}.log"
        environment = os.environ | {"STATE_DIRECTORY": str(self._scratch)}
        with contextlib.ExitStack() as stack:
            stderr: IO[bytes] | None = None if self._verbose else stack.enter_context(errors.open("wb"))
            # a session of its own: Ctrl-C comes to the demo alone, which then ends them in order
            process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.DEVNULL,
                stderr=stderr,
                env=environment,
                start_new_session=True,
            )
        self._started.append(Child(what, process, errors))

    def check(self) -> None:
        """Raise DemoError, with what it said last, where a process has failed."""
        for child in self._started:
            code = child.process.poll()
            if code:
                said = child.errors.read_text(errors="replace").strip() if child.errors.exists() else ""
                tail = "\n  ".join(said.splitlines()[-8:]) or "(nothing on stderr)"
                raise DemoError(f"the {child.what} ended with exit code {code}. It said:\n  {tail}")


def show(config: Path, url: str, seconds: float, children: Children) -> None:
    """Start everything, ask, and print. Raises DemoError where something is missing."""
    # heavy, so not before they are needed: `modelserver --help` lists this command too
    from modelserver.client.remote import Platform
    from modelserver.config import load_config
    from mstools.demo_sensors import simulation
    from mstools.query import describe

    say = typer.echo
    say(f"1. The daemon: modelserver run -c {config} --url '{url}'")
    children.start("daemon", "-c", "from mstools.cli import main; main()", "run", "-c", str(config), "--url", url)
    vehicle = load_config(config)
    with Platform(url, channel_prefix=vehicle.lcm.channel_prefix, name="demo", timeout=0.25, retries=0) as platform:
        bodies = first_answer(platform.get_body_list, children)
        platform.retries = 3
        start_utime = round((time.time() + LEAD_SECONDS) * 10) * 100_000
        children.start(
            "simulated sensors",
            *("-m", "mstools.demo_sensors", "--config", str(config), "--url", url, "--seed", str(SEED)),
            *("--start-utime", str(start_utime), "--seconds", repr(seconds)),
        )
        run = simulation(vehicle, start_utime, seconds, SEED)
        say("\n2. What it knows from the geometry file, asked from this process")
        say(f"bodies            {', '.join(bodies)}")
        say(f"Digiclops has     {', '.join(platform.get_body_frame_list('Digiclops'))}")
        say(describe(platform.get_pose("Digiclops:ImagePlane", "FrontNoddingSICK:Origin")))

        say("\n3. POSE, broadcast while simulated GPS, IMU and wheels arrive from a third process; the truth beside it")
        say("   time      easting     northing       up     yaw   off by           may be off by    state")
        valid: list[PoseAnswer] = []
        received = 0
        next_row = 0.0
        for pose in poses(url, f"{vehicle.lcm.channel_prefix}POSE", start_utime, seconds, children):
            received += 1
            since = (pose.transformation.utime - start_utime) * 1e-6
            if pose.transformation.valid:
                valid.append(pose)
            if since >= next_row:
                say(row(pose, since, run.truth(pose.transformation.utime).utm, run.geodesy.origin.initial_utm))
                next_row = math.floor(since) + 1.0
        if not valid:
            raise DemoError(
                f"the pose never became valid in {seconds:g} s: {received} poses came on POSE. "
                "Run it again with --verbose; a busy machine may need --seconds 20"
            )
        say(f"   {received} poses in {seconds:g} s, {len(valid)} of them valid")

        say("\n4. Where was the camera in the world a second ago?")
        at = valid[-1].transformation.utime - 1_000_000
        say(describe(platform.get_pose("Digiclops:ImagePlane", "World:UTM", at=at)))
        history = platform.get_history(at - 1_000_000, at, 10.0)
        say(f"get_history gave {len(history)} poses of the second before that")
        say("\n5. What it says to a slip")
        try:
            platform.get_transformation("Digiclop:ImagePlane", "Raptor:CG")
        except QueryError as error:
            say(f"{error}. Nearest: {', '.join(error.nearest)}")
    say(f"\nDone. Next: modelserver run -c {vehicle_file()}, and in another shell: modelserver bodies")


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
                    f"the daemon gave no answer within {START_LIMIT:g} s. Does multicast work on loopback here? "
                    "Try: ip route add 224.0.0.0/4 dev lo, and run the demo with --verbose"
                ) from None


def poses(url: str, channel: str, start_utime: int, seconds: float, children: Children) -> Iterator[PoseAnswer]:
    """Yield what is broadcast from the start of the drive on, until its end."""
    from modelserver.wire.channels import literal
    from modelserver.wire.codec import decode
    from modelserver.wire.provider import open_lcm, resolve_url

    fresh: list[PoseAnswer] = []
    bus = open_lcm(resolve_url(url))
    subscription = bus.subscribe(literal(channel), lambda _, data: fresh.append(decode("pose_transform_t", data)))
    subscription.set_queue_capacity(0)
    end = time.monotonic() + start_utime * 1e-6 - time.time() + seconds
    while time.monotonic() < end:
        bus.handle_timeout(100)
        yield from (pose for pose in fresh if pose.transformation.utime >= start_utime)
        fresh.clear()
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
