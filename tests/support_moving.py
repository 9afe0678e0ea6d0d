"""A vehicle with joints whose every motion is known: truth for the platform's answers."""

from __future__ import annotations

import math

import numpy as np

from modelserver.estimation.history import History
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint, JointType, Mimic
from modelserver.geometry.model import Model
from modelserver.geometry.parts import Sigma
from modelserver.joints import JointHistory
from modelserver.messages import Estimate, JointSample, JointsSample, Origin, SensorHeader, VehicleMotion
from modelserver.query.view import PlatformView
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose

T0 = 1_700_000_000_000_000
S = 1_000_000
ORIGIN = Origin(483_000.0, 5_568_000.0, 700.0, 12, True, 77)
UTM, ENU, ODOM = names.WORLD_UTM, names.WORLD_ENU, names.ODOM
BASE, SCAN, DEEP = "Rover:Base", "Laser:Scan", "Deep:Tip"
SURVEY = Sigma((0.002, 0.002, 0.002), (0.002, 0.002, 0.002))

SPEED, TURN = 3.0, 0.5
NOD = math.radians(20.0)
NOD_RATE = math.radians(30.0) / NOD
"""Angular frequency at which the peak rate is 30 deg/s."""


def rover(sigma: Sigma | None = SURVEY) -> Model:
    """A rover with a nodding laser, an arm of three further joints, and a follower."""
    builder = ModelBuilder("rover")
    rover = builder.add_body("Rover")
    rover.add_frame("Base").add_frame("Mast", Pose.from_rpy((0.8, 0.1, 1.2), 0.0, 0.2, 0.1), sigma=sigma)
    rover.add_frame("Shoulder", Pose.from_rpy((-0.4, 0.3, 0.6), 0.1, 0.0, -0.3), sigma=sigma)
    laser = builder.add_body("Laser")
    laser.add_frame("Axle").add_frame("Scan", Pose.from_rpy((0.05, 0.0, 0.1), 0.0, 0.0, 0.02), sigma=sigma)
    for name in ("Upper", "Fore", "Deep", "Finger"):
        body = builder.add_body(name)
        body.add_frame("Root")
        body.add_frame("Tip", Pose.from_rpy((0.3, 0.02, -0.01), 0.05, -0.1, 0.2), sigma=sigma)
    nod = Joint(JointType.REVOLUTE, (0.0, 1.0, 0.0), (-0.6,), (0.6,), (2.0,), sigma=(0.001,))
    builder.add_constraint("Nod", "Rover:Mast", "Laser:Axle", Pose((0.0, 0.0, 0.1)), sigma=sigma, joint=nod)
    slide = Joint(JointType.PRISMATIC, (1.0, 0.0, 0.0), rate_limit=(1.0,), default=(0.1,), sigma=(0.001,))
    builder.add_constraint("Slide", "Rover:Shoulder", "Upper:Root", sigma=sigma, joint=slide)
    ball = Joint(JointType.SPHERICAL, sigma=(0.002, 0.002, 0.002))
    # passed backward
    builder.add_constraint("Ball", "Fore:Root", "Upper:Tip", Pose((0.02, 0.0, 0.0)), sigma=sigma, joint=ball)
    table = Joint(JointType.PLANAR, (0.0, 0.6, 0.8), sigma=(0.001, 0.001, 0.002))
    builder.add_constraint("Table", "Fore:Tip", "Deep:Root", sigma=sigma, joint=table)
    follow = Joint(JointType.REVOLUTE, (0.0, 0.0, 1.0), mimic=Mimic("Nod", -0.5, 0.1))
    builder.add_constraint("Finger", "Deep:Tip", "Finger:Root", sigma=sigma, joint=follow)
    return builder.build()


def positions(seconds: float) -> dict[str, tuple[float, float]]:
    """Return the true position and rate of every coordinate."""
    waves = {
        "Nod": (NOD, NOD_RATE, 0.0),
        "Slide": (0.1, 1.1, 0.4),
        "Ball.rx": (0.5, 0.8, 0.1),
        "Ball.ry": (0.4, 0.9, 0.7),
        "Ball.rz": (0.3, 1.2, 1.3),
        "Table.x": (0.05, 1.0, 0.2),
        "Table.y": (0.04, 1.3, 0.9),
        "Table.turn": (0.6, 0.7, 1.9),
    }
    return {
        name: (size * math.sin(w * seconds + phase), size * w * math.cos(w * seconds + phase))
        for name, (size, w, phase) in waves.items()
    }


def vehicle(seconds: float) -> Pose:
    """Return the true pose of the base in World:UTM: a circle, on a slope that tilts."""
    yaw = 0.3 + TURN * seconds
    r = SPEED / TURN
    place = (10.0 + r * math.sin(yaw), 20.0 - r * math.cos(yaw), 0.5 * math.sin(0.4 * seconds))
    return Pose.from_rpy(place, 0.05 * math.sin(0.6 * seconds), 0.04 * math.sin(0.5 * seconds), yaw)


def twist(seconds: float, step: float = 1e-5) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the true velocity and turn rate of the base along its own axes, by central differences."""
    before, here, after = vehicle(seconds - step), vehicle(seconds), vehicle(seconds + step)
    v = (after.position - before.position) / (2.0 * step)
    turned = before.wxyz[0], -before.wxyz[1], -before.wxyz[2], -before.wxyz[3]
    w = np.array(so3.logarithm(so3.normalize(so3.multiply(after.wxyz, turned)))) / (2.0 * step)
    back = here.rotation.T
    a, b, c = (back @ v).tolist()
    d, e, f = (back @ w).tolist()
    return (a, b, c), (d, e, f)


def acceleration(seconds: float, step: float = 1e-3) -> tuple[float, float, float]:
    """Return the true acceleration of the base along its own axes."""
    p = [vehicle(seconds + n * step).position for n in (-1, 0, 1)]
    x, y, z = (vehicle(seconds).rotation.T @ ((p[0] - 2.0 * p[1] + p[2]) / step**2)).tolist()
    return (x, y, z)


def estimate(seconds: float, sigma: float = 0.05) -> Estimate:
    """Return the estimate without any error."""
    pose = vehicle(seconds)
    v, w = twist(seconds)
    numbers = tuple(np.diag([sigma**2] * 3 + [(0.2 * sigma) ** 2] * 3).ravel().tolist())
    drift = tuple(np.diag([(0.01 * seconds) ** 2] * 3 + [1e-6] * 2 + [(0.001 * seconds) ** 2]).ravel().tolist())
    shift = Pose.from_rpy((-3.0, 7.0, 0.0), 0.0, 0.0, -0.4)
    twist_covariance = tuple(np.diag([1e-4] * 3 + [1e-6] * 3).ravel().tolist())
    return Estimate(
        T0 + round(seconds * S),
        shift @ pose,
        pose,
        pose,
        numbers,
        drift,
        origin=ORIGIN,
        motion=VehicleMotion(v, w, acceleration(seconds), covariance=lambda: twist_covariance, acceleration_sigma=0.02),
    )


def joints_at(seconds: float) -> JointsSample:
    """Return the sample of all joints, without any error."""
    header = SensorHeader(T0 + round(seconds * S), "arm")
    return JointsSample(header, tuple(JointSample(n, q, 0.001, r, 0.002) for n, (q, r) in positions(seconds).items()))


def view(
    seconds: float = 4.0, pose_hz: float = 100.0, joint_hz: float = 50.0, sigma: Sigma | None = SURVEY
) -> PlatformView:
    """Return the platform after so many seconds of exact poses and joints."""
    model = rover(sigma)
    joints, history = JointHistory(model.joints.values(), 60.0), History(60.0)
    for n in range(int(seconds * joint_hz) + 1):
        joints, rejected = joints.update(joints_at(n / joint_hz), T0 + round(n / joint_hz * S))
        assert not rejected
    for n in range(int(seconds * pose_hz) + 1):
        history = history.append(estimate(n / pose_hz))

    class TrueEstimates:
        """A localizer with exact estimates."""

        utime = history.last

        def estimate(self, utime: int) -> Estimate:
            return estimate((utime - T0) / S)

    return PlatformView(model, BASE, TrueEstimates(), history, joints=joints)  # type: ignore[arg-type]


def truth(interest: str, reference: str, at: float, reference_at: float | None = None, fixed: str = UTM) -> Pose:
    """Return the true pose of a frame in another, by the product of everything on the path."""
    there = _in_world(reference, at if reference_at is None else reference_at)
    return there.inverse() @ _in_world(interest, at)


_MODEL = rover(None)


def _in_world(frame: str, seconds: float) -> Pose:
    if frame == UTM:
        return Pose.identity()
    route = _MODEL.get_kinematic_path(frame, BASE)
    where = positions(seconds)
    placed = []
    for leg in route.joints:
        drive = _MODEL.drives[leg.name]
        placed.append(tuple(drive.multiplier * where[name][0] + drive.offset for name in drive.names))
    return vehicle(seconds) @ route.compute_pose(placed)
