"""The localizer works at the point that does not slide; POSE is another frame of the vehicle."""

from __future__ import annotations

import math

import pytest

from modelserver import core
from modelserver.core import CoreSettings, Instant
from modelserver.earth.geodesy import origin_at
from modelserver.errors import NotConnectedError, UnknownFrameError
from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.estimation.sensor_rig import Mounts
from modelserver.geometry.builder import ModelBuilder
from modelserver.messages import GpsSample, ImuSample, PublishPose, Tick
from modelserver.simulation import Simulation, Trajectory, figure_eight
from modelserver.transforms.pose import Pose

BASE, AXLE, GPS, IMU = "Car:CG", "Car:RearAxle", "Car:Antenna", "Car:Imu"
START = 1_700_000_000_000_000


def car() -> ModelBuilder:
    builder = ModelBuilder("car")
    body = builder.add_body("Car")
    body.add_frame("CG").add_frame("RearAxle", Pose((-0.8, 0.0, -0.5))).add_frame("Antenna", Pose((0.3, 0.2, 1.2)))
    body.add_frame("Imu", Pose((0.1, 0.0, 0.4))).add_frame("Top", Pose((0.0, 0.0, 1.0)))
    builder.add_body("Unit").add_frame("Origin")
    return builder.add_constraint("UnitFixed", "Car:Top", "Unit:Origin")


def errors_in_turns(rolling_frame: str) -> tuple[float, float]:
    """Return the largest yaw error (degrees) and position error (meters) of POSE while valid, late in the drive."""
    model = car().build()
    simulation = Simulation(
        model,
        BASE,
        Trajectory(figure_eight(speed=3.0, radius=6.0, stationary=2.0, ramp=2.0, laps=1), yaw=0.5),
        origin_at(50.27, -111.18, 700.0),
        gps_frame=GPS,
        imu_frame=IMU,
        rolling_frame=AXLE,
        seed=3,
        start_utime=START,
    )
    mounts = Mounts.from_model(model, rolling_frame, GPS, IMU)
    localizer = RawLocalizer.start(mounts, None, origin_at(50.27, -111.18, 700.0))
    state = core.start(CoreSettings(BASE, rolling_frame), model, localizer, Instant(0, START))
    worst_yaw = worst_place = 0.0
    ticks = 0
    for sample in simulation.events(25.0):
        if not isinstance(sample, (GpsSample, ImuSample)):
            continue
        now = Instant((sample.header.host_utime - START) * 1000, sample.header.host_utime)
        state, _ = core.step(state, sample, now)
        ticks += 1
        if ticks % 20 or now.utime < START + 12_000_000:
            continue
        state, outputs = core.step(state, Tick(), now)
        (pose,) = [each for each in outputs if isinstance(each, PublishPose)]
        assert pose.world.transformation.frame_of_interest == BASE
        if pose.world.transformation.is_valid:
            truth = simulation.truth(now.utime).utm
            moved, _ = pose.world.transformation.pose.distance(truth)
            yaw = math.remainder(pose.world.transformation.rpy[2] - truth.rpy[2], math.tau)
            worst_yaw, worst_place = max(worst_yaw, abs(math.degrees(yaw))), max(worst_place, moved)
            assert abs(yaw) <= pose.world.heading_protection_level or rolling_frame == BASE
    return worst_yaw, worst_place


@pytest.mark.slow
def test_given_the_axle_as_rolling_frame_then_pose_is_right_in_turns_where_the_cg_slides() -> None:
    yaw, place = errors_in_turns(AXLE)
    assert yaw < 2.5
    assert place < 0.3
    wrong_yaw, _ = errors_in_turns(BASE)
    assert wrong_yaw > 4.0  # what the setting is for: atan(0.8 m / 6 m) is 7.6 degrees


def test_given_a_rolling_frame_that_is_none_then_the_core_does_not_start() -> None:
    model = car().build()
    with pytest.raises(UnknownFrameError):
        core.start(CoreSettings(BASE, "Car:RearAxel"), model, None, Instant(0, 1))
    builder = car()
    builder.add_body("Other").add_frame("x")
    with pytest.raises(NotConnectedError):
        core.start(CoreSettings(BASE, "Other:x"), builder.check()[0], None, Instant(0, 1))
