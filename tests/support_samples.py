"""A small vehicle for tests of the server: its files, samples of a straight drive, and a scripted localizer."""

from __future__ import annotations

import math
import random
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from modelserver.core import CoreSettings, CoreState, Instant, start
from modelserver.earth.geodesy import Geodesy, origin_at
from modelserver.estimation.history import LocalizerEvent
from modelserver.geometry import Model, ModelBuilder, Sigma
from modelserver.messages import (
    STALE_SENSORS,
    VALID,
    Decision,
    Estimate,
    FixType,
    GpsSample,
    ImuSample,
    Invalid,
    LoadModel,
    LocalizerSummary,
    Mode,
    NavigationState,
    Origin,
    PersistOrigin,
    Phase,
    Quality,
    Rejected,
    RequestHeader,
    Sample,
    SensorHeader,
    SwitchMode,
    Verdict,
)
from modelserver.server.reloading import PollReload
from modelserver.transforms import Pose

START = 1_700_000_000_000_000
ORIGIN = origin_at(50.27, -111.1, 700.0)
GEODESY = Geodesy(ORIGIN)
ME = RequestHeader(77, "REPLY_TEST")
Fix: TypeAlias = GpsSample | ImuSample


# --- the vehicle --------------------------------------------------------------------------------------------


def cart(sigma: bool = False) -> Model:
    """Return a cart with antenna, IMU and camera, and a lamp that is not connected to it."""
    survey = Sigma((0.01, 0.02, 0.03), (0.001, 0.002, 0.003)) if sigma else None
    builder = ModelBuilder("cart")
    body = builder.add_body("Cart")
    body.add_frame("Base")
    body.add_frame("Antenna", Pose((-0.4, 0.2, 1.2)))
    body.add_frame("Imu", Pose((0.1, 0.0, 0.3)))
    body.add_frame("Mast", Pose.from_rpy((0.5, 0.1, 1.0), 0.0, 0.2, 0.3), sigma=survey)
    builder.add_body("Camera").add_frame("Origin")
    builder.add_constraint(
        "Mounted", "Cart:Mast", "Camera:Origin", Pose.from_rpy((0, 0, 0.1), 0.1, 0, 0.5), sigma=survey
    )
    builder.add_body("Lamp").add_frame("Origin")
    return builder.build()


GEOMETRY = """\
modelserver: geometry/1
name: cart
bodies:
  Cart:
    frames:
      Base:
      Antenna: {xyz: [-0.4, 0.2, 1.2]}
      Imu: {xyz: [0.1, 0, 0.3]}
      Mast: {xyz: [0.5, 0.1, 1.0]}
  Camera:
    frames:
      Origin:
constraints:
  Mounted: {from: Cart:Mast, to: Camera:Origin, xyz: [0, 0, 0.1]}
"""

VEHICLE = """\
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Base
state_directory: state
sensors:
  gps: {channel: GPS, frame: Cart:Antenna}
  imu: {channel: IMU, frame: Cart:Imu}
"""


FORWARD = "filter: {reverse_speed: 1.5}"
"""Setting for `drive`, which starts at 2 m/s without wheels: only this makes its direction forward."""


def write_vehicle(folder: Path, vehicle: str = VEHICLE, geometry: str = GEOMETRY) -> Path:
    """Write both files; return the path of the vehicle file. One without localization settings gets `FORWARD`."""
    (folder / "geometry.yaml").write_text(geometry)
    path = folder / "vehicle.yaml"
    path.write_text(vehicle if "localization:" in vehicle else f"{vehicle}localization: {{{FORWARD}}}\n")
    return path


# --- a straight drive ---------------------------------------------------------------------------------------


def gps(utime: int, east: float = 0.0, speed: float = 2.0, source: str = "gps") -> GpsSample:
    """Return a fix with velocity, `east` meters from the origin, driving east."""
    latitude, longitude, height = GEODESY.geodetic_from_enu((east, 0.0, 0.0))
    variance = 0.25
    return GpsSample(
        SensorHeader(utime, source),
        FixType.FIX_3D,
        latitude,
        longitude,
        height,
        position_covariance=(variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, 4 * variance),
        velocity=(speed, 0.0, 0.0),
        velocity_covariance=(0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.01),
    )


def imu(utime: int, source: str = "imu") -> ImuSample:
    """Return the IMU sample of a level straight drive with vibration; the same for the same instant."""
    noise = random.Random(utime).gauss
    rate = (noise(0.0, 0.02), noise(0.0, 0.02), noise(0.0, 0.02))
    force = (noise(0.0, 0.3), noise(0.0, 0.3), 9.80665 + noise(0.0, 0.3))
    return ImuSample(SensorHeader(utime, source), rate, force)


def drive(seconds: float, start_utime: int = START, imu_hz: float = 50.0, gps_hz: float = 10.0) -> Iterator[Fix]:
    """Yield the samples of a drive due east at 2 m/s, by their stamps."""
    every = round(imu_hz / gps_hz)
    for n in range(round(seconds * imu_hz)):
        t = n / imu_hz
        utime = start_utime + round(t * 1e6)
        yield imu(utime)
        if n % every == 0:
            yield gps(utime, 2.0 * t)


# --- a scripted localizer -----------------------------------------------------------------------------------


_COVARIANCE = tuple(np.diag([0.04, 0.09, 0.16, 1e-4, 4e-4, 9e-4]).ravel().tolist())


@dataclass(frozen=True)
class ScriptedLocalizer:
    """A localizer that is controlled by the source name of each sample.

    `refuse:REASON` rejects the sample; `reject:REASON` rejects it with a decision; `decide:N` accepts it with N
    decisions; `late` accepts it without a step in time; `latch` sets the origin; `ignore` changes nothing; `break`
    raises; any other source is accepted. Mode requests are applied at once. The vehicle moves at 1 m/s and has a pose
    in the world from its first sample. `stale_s` after the newest sample estimates are invalid. With `has_state` there
    is a navigation state.
    """

    newest: int = 0
    count: int = 0
    origin: Origin | None = ORIGIN
    epoch: int = 0
    stale_s: float = 1.0
    invalid: Invalid = VALID
    covariance: tuple[float, ...] = _COVARIANCE
    mode: Mode = Mode.FULL
    has_state: bool = False

    @property
    def utime(self) -> int:
        return self.newest

    def process(self, sample: Sample | SwitchMode) -> tuple[ScriptedLocalizer, tuple[LocalizerEvent, ...]]:
        command, _, argument = sample.header.source.partition(":")
        if isinstance(sample, SwitchMode):
            return replace(self, mode=sample.mode), ()
        if command == "break":
            raise RuntimeError("an error of the localizer's own:\nFORGED line \x1b[31m")
        if command == "ignore":
            return self, ()
        if command == "refuse":
            return replace(self, count=self.count), (Rejected(f"sensor:{sample.header.source}", argument),)
        if command == "reject":
            return replace(self, count=self.count), (make_decision(sample, Verdict.REJECTED, argument),)
        if command == "late":
            return replace(self, count=self.count + 1), ()
        accepted = replace(self, newest=sample.header.utime, count=self.count + 1)
        if command == "latch":
            return replace(accepted, origin=ORIGIN), (PersistOrigin(ORIGIN),)
        if command == "decide":
            return accepted, tuple(make_decision(sample, Verdict.USED, "", n) for n in range(int(argument)))
        return accepted, ()

    def navigation(self, utime: int) -> NavigationState | None:
        if not self.has_state:
            return None
        return NavigationState(
            utime,
            self.mode,
            Phase.ALIGNED,
            False,
            self.invalid,
            self.epoch,
            50.27,
            -111.1,
            700.0,
            Pose((float(self.count), 0.0, 0.0)),
            (1.0, 0.0, 0.0),
            (0.0, 0.0, 0.01),
            (),
            ("position_east",),
            (0.5,),
            (0.25,),
        )

    def find_stale_sensors(self, utime: int) -> Invalid:
        return self.estimate(utime).invalid & STALE_SENSORS

    def summary(self, utime: int) -> LocalizerSummary:
        return LocalizerSummary(self.mode, Phase.ALIGNED if self.has_state else None, False, self.newest)

    def defer_estimate(self, utime: int) -> Estimate:
        return self.estimate(utime)

    def estimate(self, utime: int) -> Estimate:
        if not self.newest:
            return Estimate(utime, Pose.identity(), invalid=Invalid.NO_FIX | Invalid.NO_IMU)
        x = (utime - START) * 1e-6
        invalid = self.invalid
        if utime > self.newest + self.stale_s * 1e6:
            invalid |= Invalid.STALE_IMU | Invalid.STALE_GPS
        if self.origin is None:
            return Estimate(utime, Pose((x, 0, 0)), invalid=invalid | Invalid.NO_ORIGIN, pose_epoch=self.epoch)
        yaw = 0.01 * x
        return Estimate(
            utime,
            Pose.from_rpy((x, 0.0, 0.0), 0.0, 0.0, yaw),
            Pose.from_rpy((x + 100.0, 50.0, 5.0), 0.0, 0.0, yaw + 0.5),
            Pose.from_rpy((x + 101.0, 51.0, 5.0), 0.0, 0.0, yaw + 0.52),
            self.covariance,
            tuple(np.diag([0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4]).ravel().tolist()),
            invalid,
            Quality.PREDICTED if utime > self.newest else Quality(0),
            self.epoch,
            self.origin,
            1.5,
            0.1,
            math.nan,
        )


def make_decision(sample: Sample, verdict: Verdict, reason: str = "", number: int = 0) -> Decision:
    """Return the decision on a sample's one measurement."""
    header = sample.header
    return Decision(header.utime, header.source, header.seq, f"speed_{number}", verdict, reason, (0.5,), (1.0,), (0.5,))


def instant_at(utime: int) -> Instant:
    """Return the instant at which the host's clock reads `utime`."""
    return Instant((utime - START) * 1000 + 10_000_000_000, utime)


def start_core(localizer: ScriptedLocalizer | None = ScriptedLocalizer(), **settings: object) -> CoreState:
    """Return the initial core state of the cart at START."""
    return start(CoreSettings("Cart:Base", vehicle="cart", **settings), cart(), localizer, instant_at(START))  # type: ignore[arg-type]


def wait_for_reload(
    begin: Callable[[LoadModel, CoreState], PollReload],
) -> Callable[[LoadModel, CoreState], PollReload]:
    """Return the function with its thread joined, so that the first poll has the result."""

    def begin_and_wait(command: LoadModel, state: CoreState) -> PollReload:
        poll = begin(command, state)
        for thread in threading.enumerate():
            if thread.name == "reload":
                thread.join(20.0)
        return poll

    return begin_and_wait
