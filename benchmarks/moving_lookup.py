"""A lookup between samples through nine joints that all move, beside pytransform3d's temporal transform manager.

Measured is one question from a program: `PlatformView.transformation` of the arm's last frame in its first at a random
instant, joints at 50 Hz for 40 s, each answer of an instant of its own. Between two joints stands a mount, so that the
route has nine joints and 29 edges in all; the peer's chain has one moving edge for each joint with its mount, the same
samples and the same instants. pytransform3d is optional: without it the ratio is left out, and said so.
"""

from __future__ import annotations

import itertools
import math
import random
import statistics
import time
from collections.abc import Callable

import numpy as np

from benchmarks.support import interleaved, ratio, verdict
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint, JointType
from modelserver.geometry.parts import Sigma
from modelserver.history import History
from modelserver.joints.joints import Joints
from modelserver.messages import JointSample, JointsSample, SensorHeader, TimeQuery
from modelserver.platform import PlatformView
from modelserver.spatial.pose import Pose

JOINTS, SAMPLES, STEP_US = 9, 2000, 20_000
START = 1_700_000_000_000_000
MOUNT = Pose.from_rpy((0.3, 0.01, 0.02), 0.1, 0.2, 0.3)
TURNING = Joint(JointType.REVOLUTE, (0.0, 0.6, 0.8), (-3.0,), (3.0,), sigma=(0.001,))
ROUNDS, CALLS = 15, 300
MEMORY_S = 3600


def arm() -> PlatformView:
    """Return an arm of nine joints that have all been told of for 40 s."""
    builder, sigma = ModelBuilder("arm"), Sigma((0.001,) * 3, (0.001,) * 3)
    for number in range(JOINTS + 1):
        builder.body(f"Link{number}").frame("In").frame("Out", MOUNT, sigma=sigma)
    for number in range(JOINTS):
        ends = (f"Link{number}:Out", f"Link{number + 1}:In")
        builder.constraint(f"Joint{number}", *ends, sigma=sigma, joint=TURNING)
    model = builder.build()
    joints = Joints(model.joints.values(), 60.0)
    for sample in range(SAMPLES):
        joints = joints.taken(told(sample), START + sample * STEP_US)[0]
    return PlatformView(model, "Link0:In", None, History(60.0), joints=joints)


def position(joint: int, sample: int) -> float:
    return 0.5 * math.sin(0.02 * sample + joint)


def told(sample: int) -> JointsSample:
    readings = [JointSample(f"Joint{n}", position(n, sample), 0.001, 0.1, 0.01) for n in range(JOINTS)]
    return JointsSample(SensorHeader(START + sample * STEP_US, "arm"), tuple(readings))


def peer(instants: list[float]) -> Callable[[], object] | None:
    """Return a lookup of pytransform3d's on the same chain; None without it."""
    try:
        from pytransform3d.transform_manager import NumpyTimeseriesTransform, TemporalTransformManager
    except ImportError:
        return None
    manager = TemporalTransformManager()
    times = np.arange(SAMPLES) * STEP_US * 1e-6
    for joint in range(JOINTS):
        poses = [MOUNT @ TURNING.motion((position(joint, sample),)) for sample in range(SAMPLES)]
        series = NumpyTimeseriesTransform(times, np.array([(*pose.xyz, *pose.wxyz) for pose in poses]))
        manager.add_transform(f"link{joint + 1}", f"link{joint}", series)
    at = itertools.cycle(instants)
    return lambda: manager.get_transform_at_time(f"link{JOINTS}", "link0", next(at))


def _difference(view: PlatformView, lookup: Callable[[], object], instants: list[float]) -> float:
    """Return by how much the two answers differ at most: both are to do the same work."""
    mount = np.asarray(MOUNT.matrix)
    worst = 0.0
    for seconds in instants[:20]:
        mine = view.transformation(
            f"Link{JOINTS}:Out", "Link0:In", TimeQuery(START + round(seconds * 1e6))
        ).transformation
        worst = max(worst, float(np.abs(np.asarray(lookup()) @ mount - mine.matrix).max()))
    return worst


def _memory() -> tuple[int, int]:
    """Return readings held and list entries kept of one joint at 50 Hz after an hour, with 60 s configured."""
    joints = Joints(arm_joints().values(), 60.0)
    for sample in range(MEMORY_S * 50):
        at = START + sample * STEP_US
        joints = joints.taken(JointsSample(SensorHeader(at, "arm"), (JointSample("Joint0", 0.1),)), at)[0]
    track = joints.tracks["Joint0"]
    return len(track), sum(len(block.times) for block in track._blocks)


def arm_joints() -> dict[str, object]:
    return arm().model.joints  # type: ignore[return-value]


def main() -> int:
    view, rng = arm(), random.Random(1)
    seconds = [rng.randrange((SAMPLES - 1) * STEP_US) * 1e-6 for _ in range(5000)]
    at = itertools.cycle([TimeQuery(START + round(each * 1e6)) for each in seconds])

    def lookup() -> object:
        return view.transformation(f"Link{JOINTS}:Out", "Link0:In", next(at))

    def sure() -> object:
        return view.transformation(f"Link{JOINTS}:Out", "Link0:In", next(at)).transformation.covariance

    actions: dict[str, Callable[[], object]] = {"lookup": lookup, "with covariance": sure}
    other = peer(seconds)
    if other is not None:
        actions["pytransform3d"] = other
    interleaved(2, CALLS, actions)  # warm up: the interpreter specializes what runs often
    times = interleaved(ROUNDS, CALLS, actions)
    for name, values in times.items():
        print(f"  {name:16} {statistics.median(values) * 1e6:8.1f} us, median of {ROUNDS} rounds")
    holds = verdict("a lookup through nine joints", statistics.median(times["lookup"]) * 1e6, 60.0, "us")
    holds &= verdict("with its covariance, to without", ratio(times["with covariance"], times["lookup"]), 3.0, "x")
    check = peer(seconds)
    if check is None:
        print("  pytransform3d is not installed (pip install pytransform3d): no ratio to it")
    else:
        holds &= verdict(
            "to pytransform3d's temporal manager", ratio(times["lookup"], times["pytransform3d"]), 0.15, "x"
        )
        holds &= verdict("the two answers differ by", _difference(view, check, seconds) * 1e3, 1.0, "mm")
    begin = time.perf_counter()
    held, kept = _memory()
    print(f"  an hour of one joint at 50 Hz was taken in {time.perf_counter() - begin:.1f} s")
    holds &= verdict("readings held after it, with 60 s configured", held, 60 * 50 + 1, "")
    holds &= verdict("entries in memory for them", kept, 2 * (60 * 50 + 1) + 1, "")
    return 0 if holds else 1
