"""Lookup between samples through nine moving joints, relative to pytransform3d's temporal transform manager.

The time is that of `PlatformView.transformation` of the arm's last frame in its first at random instants, joints at
50 Hz for 40 s. Between two joints there is a mount, so that the path has nine joints and 29 edges; the peer's chain has
one moving edge per joint and mount, with the same samples and instants. Without pytransform3d (optional) the ratio is
left out, with a message.
"""

from __future__ import annotations

import itertools
import math
import random
import statistics
import time
from collections.abc import Callable

import numpy as np

from benchmarks.support import measure_interleaved, print_verdict, ratio
from modelserver.estimation.history import History
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint, JointType
from modelserver.geometry.parts import Sigma
from modelserver.joints import JointHistory
from modelserver.messages import JointSample, JointsSample, SensorHeader, TimeQuery
from modelserver.query.view import PlatformView
from modelserver.transforms.pose import Pose

JOINTS, SAMPLES, STEP_US = 9, 2000, 20_000
START = 1_700_000_000_000_000
MOUNT = Pose.from_rpy((0.3, 0.01, 0.02), 0.1, 0.2, 0.3)
TURNING = Joint(JointType.REVOLUTE, (0.0, 0.6, 0.8), (-3.0,), (3.0,), sigma=(0.001,))
ROUNDS, CALLS = 15, 300
MEMORY_S = 3600


def build_arm() -> PlatformView:
    """Return an arm of nine joints with samples of 40 s."""
    builder, sigma = ModelBuilder("arm"), Sigma((0.001,) * 3, (0.001,) * 3)
    for number in range(JOINTS + 1):
        builder.add_body(f"Link{number}").add_frame("In").add_frame("Out", MOUNT, sigma=sigma)
    for number in range(JOINTS):
        ends = (f"Link{number}:Out", f"Link{number + 1}:In")
        builder.add_constraint(f"Joint{number}", *ends, sigma=sigma, joint=TURNING)
    model = builder.build()
    joints = JointHistory(model.joints.values(), 60.0)
    for sample in range(SAMPLES):
        joints = joints.update(make_sample(sample), START + sample * STEP_US)[0]
    return PlatformView(model, "Link0:In", None, History(60.0), joints=joints)


def joint_position(joint: int, sample: int) -> float:
    return 0.5 * math.sin(0.02 * sample + joint)


def make_sample(sample: int) -> JointsSample:
    readings = [JointSample(f"Joint{n}", joint_position(n, sample), 0.001, 0.1, 0.01) for n in range(JOINTS)]
    return JointsSample(SensorHeader(START + sample * STEP_US, "arm"), tuple(readings))


def make_peer_lookup(instants: list[float]) -> Callable[[], object] | None:
    """Return pytransform3d's lookup on the same chain; None without it."""
    try:
        from pytransform3d.transform_manager import NumpyTimeseriesTransform, TemporalTransformManager
    except ImportError:
        return None
    manager = TemporalTransformManager()
    times = np.arange(SAMPLES) * STEP_US * 1e-6
    for joint in range(JOINTS):
        poses = [MOUNT @ TURNING.compute_pose((joint_position(joint, sample),)) for sample in range(SAMPLES)]
        series = NumpyTimeseriesTransform(times, np.array([(*pose.xyz, *pose.wxyz) for pose in poses]))
        manager.add_transform(f"link{joint + 1}", f"link{joint}", series)
    at = itertools.cycle(instants)
    return lambda: manager.get_transform_at_time(f"link{JOINTS}", "link0", next(at))


def _max_difference(view: PlatformView, lookup: Callable[[], object], instants: list[float]) -> float:
    """Return the largest difference of the two results."""
    mount = np.asarray(MOUNT.matrix)
    worst = 0.0
    for seconds in instants[:20]:
        mine = view.transformation(
            f"Link{JOINTS}:Out", "Link0:In", TimeQuery(START + round(seconds * 1e6))
        ).transformation
        worst = max(worst, float(np.abs(np.asarray(lookup()) @ mount - mine.matrix).max()))
    return worst


def _measure_memory() -> tuple[int, int]:
    """Return the samples and list entries of one joint at 50 Hz after an hour, with a history of 60 s."""
    joints = JointHistory(arm_joints().values(), 60.0)
    for sample in range(MEMORY_S * 50):
        at = START + sample * STEP_US
        joints = joints.update(JointsSample(SensorHeader(at, "arm"), (JointSample("Joint0", 0.1),)), at)[0]
    track = joints.tracks["Joint0"]
    return len(track), sum(len(block.times) for block in track._blocks)


def arm_joints() -> dict[str, object]:
    return build_arm().model.joints  # type: ignore[return-value]


def main() -> int:
    view, rng = build_arm(), random.Random(1)
    seconds = [rng.randrange((SAMPLES - 1) * STEP_US) * 1e-6 for _ in range(5000)]
    at = itertools.cycle([TimeQuery(START + round(each * 1e6)) for each in seconds])

    def lookup() -> object:
        return view.transformation(f"Link{JOINTS}:Out", "Link0:In", next(at))

    def sure() -> object:
        return view.transformation(f"Link{JOINTS}:Out", "Link0:In", next(at)).transformation.covariance

    actions: dict[str, Callable[[], object]] = {"lookup": lookup, "with covariance": sure}
    other = make_peer_lookup(seconds)
    if other is not None:
        actions["pytransform3d"] = other
    measure_interleaved(2, CALLS, actions)  # warm up: the interpreter specializes what runs often
    times = measure_interleaved(ROUNDS, CALLS, actions)
    for name, values in times.items():
        print(f"  {name:16} {statistics.median(values) * 1e6:8.1f} us, median of {ROUNDS} rounds")
    holds = print_verdict("a lookup through nine joints", statistics.median(times["lookup"]) * 1e6, 60.0, "us")
    holds &= print_verdict(
        "with its covariance, to without", ratio(times["with covariance"], times["lookup"]), 3.0, "x"
    )
    check = make_peer_lookup(seconds)
    if check is None:
        print("  pytransform3d is not installed (pip install pytransform3d): no ratio to it")
    else:
        holds &= print_verdict(
            "to pytransform3d's temporal manager", ratio(times["lookup"], times["pytransform3d"]), 0.15, "x"
        )
        holds &= print_verdict("the two answers differ by", _max_difference(view, check, seconds) * 1e3, 1.0, "mm")
    begin = time.perf_counter()
    held, entries = _measure_memory()
    print(f"  an hour of one joint at 50 Hz was processed in {time.perf_counter() - begin:.1f} s")
    holds &= print_verdict("readings held after it, with 60 s configured", held, 60 * 50 + 1, "")
    holds &= print_verdict("entries in memory for them", entries, 2 * (60 * 50 + 1) + 1, "")
    return 0 if holds else 1
