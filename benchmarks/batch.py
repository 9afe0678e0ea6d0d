"""A batch of 1000 poses of a nodding laser in the world in one query over LCM, with and without covariances.

The client queries a core in a process of its own over loopback; the time is that of `Platform.get_transformations`,
including the arrays of poses. The core holds 20 s of vehicle poses at 100 Hz and of joints at 50 Hz.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from pathlib import Path

import lcm
import numpy as np

from benchmarks.support import free_url, measure_interleaved, print_verdict, run_process
from modelserver.client.remote import Platform
from modelserver.errors import NoServerError
from modelserver.estimation.history import History
from modelserver.geometry import names
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint, JointType
from modelserver.geometry.parts import Sigma
from modelserver.joints import JointHistory
from modelserver.messages import (
    CHANNEL_OF,
    Estimate,
    GetTransformations,
    JointSample,
    JointsSample,
    Origin,
    SensorHeader,
)
from modelserver.query.answers import DeferredAnswer
from modelserver.query.view import PlatformView, complete
from modelserver.transforms.pose import Pose
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import resolve_url

START, SECONDS, INSTANTS = 1_700_000_000_000_000, 20.0, 1000
NOD_S = 4.2
"""How long one nod takes: the instants on_request for lie within one."""
PAIR = ("Laser:Scan", names.WORLD_UTM)
ROUNDS, CALLS = 15, 10
BOUND_MS = 10.0


class _IdleLocalizer:
    """A localizer without further samples."""

    utime = START + round(SECONDS * 1e6)


def build_view() -> PlatformView:
    """Return a vehicle that drives in a circle and nods a laser at up to 30 deg/s."""
    sigma = Sigma((0.002,) * 3, (0.002,) * 3)
    builder = ModelBuilder("rover")
    builder.add_body("Rover").add_frame("Base").add_frame(
        "Mast", Pose.from_rpy((0.8, 0.1, 1.2), 0.0, 0.2, 0.1), sigma=sigma
    )
    builder.add_body("Laser").add_frame("Axle").add_frame("Scan", Pose((0.05, 0.0, 0.1)), sigma=sigma)
    nod = Joint(JointType.REVOLUTE, (0.0, 1.0, 0.0), (-0.6,), (0.6,), sigma=(0.001,))
    builder.add_constraint("Nod", "Rover:Mast", "Laser:Axle", Pose((0.0, 0.0, 0.1)), sigma=sigma, joint=nod)
    model = builder.build()
    joints, history = JointHistory(model.joints.values(), 60.0), History(60.0)
    for n in range(int(SECONDS * 50) + 1):
        at, t = START + n * 20_000, n * 0.02
        sample = JointSample("Nod", 0.35 * math.sin(1.5 * t), 0.001, 0.52 * math.cos(1.5 * t), 0.002)
        joints = joints.update(JointsSample(SensorHeader(at, "arm"), (sample,)), at)[0]
    origin = Origin(483_000.0, 5_568_000.0, 700.0, 12, True, 77)
    numbers = tuple(np.diag([0.05**2] * 3 + [0.01**2] * 3).ravel().tolist())
    for n in range(int(SECONDS * 100) + 1):
        yaw = 0.005 * n
        pose = Pose.from_rpy((6.0 * math.sin(yaw), -6.0 * math.cos(yaw), 0.0), 0.0, 0.0, yaw)
        history = history.append(Estimate(START + n * 10_000, pose, pose, pose, numbers, numbers, origin=origin))
    return PlatformView(model, "Rover:Base", _IdleLocalizer(), history, joints=joints)  # type: ignore[arg-type]


def serve() -> None:
    """Answer batch queries until the process is ended."""
    view, bus = build_view(), lcm.LCM(resolve_url())

    def on_request(channel: str, data: bytes) -> None:
        request = decode("get_transformations_request_t", data)
        for part in complete(DeferredAnswer(view, request, time.time_ns() // 1000).work()):
            bus.publish(request.header.reply_channel, encode(part))

    bus.subscribe(CHANNEL_OF[GetTransformations], on_request).set_queue_capacity(0)
    while True:
        bus.handle()


def main() -> int:
    url = free_url()
    rng = np.random.default_rng(1)
    at, wide = (START + np.sort(rng.integers(0, round(span * 1e6), INSTANTS)) for span in (NOD_S, SECONDS))
    with run_process("-m", "benchmarks.batch", "serve", url=url), Platform(url, name="batch", retries=0) as platform:
        deadline = time.monotonic() + 20.0
        while True:
            try:
                platform.get_transformations([PAIR], at[:1])
                break
            except NoServerError:
                if time.monotonic() > deadline:
                    raise
        actions = {
            "poses": lambda: platform.get_transformations([PAIR], at, covariance=False),
            "with covariances": lambda: platform.get_transformations([PAIR], at),
            "with covariances, over all 20 s": lambda: platform.get_transformations([PAIR], wide),
        }
        measure_interleaved(2, CALLS, actions)
        times = measure_interleaved(ROUNDS, CALLS, actions)
        (whole,) = platform.get_transformations([PAIR], at)
    answered = int((whole.status == 0).sum())
    print(f"  {answered} of {INSTANTS} instants answered; median of {ROUNDS} rounds")
    holds = answered == INSTANTS
    for name, values in times.items():
        ok = print_verdict(f"{INSTANTS} instants: {name}", statistics.median(values) * 1e3, BOUND_MS, "ms")
        holds &= ok or "all" in name
    return 0 if holds else 1


if __name__ == "__main__" and Path(sys.argv[0]).stem == "batch" and sys.argv[1:2] == ["serve"]:
    serve()
