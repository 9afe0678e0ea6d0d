"""Cost of a query in-process on both sides, for each pair of the Raptor's frames at its first lookup.

All pairs of frames in random order, on a new model: decoding the request, `core.step`, encoding the reply with its
covariance, and decoding the reply in the client, each by itself. Once with joints without samples, once with both
nodding axes at 50 Hz. The floor is to pack and unpack the same bytes with `struct`.
"""

from __future__ import annotations

import itertools
import math
import random
import statistics
import struct
import time
from collections.abc import Sequence
from typing import Final

from benchmarks.support import RAPTOR, print_verdict
from modelserver import core
from modelserver.client.remote import decode_pose_reply
from modelserver.core import CoreSettings, CoreState, Instant
from modelserver.formats import load_model
from modelserver.messages import JointSample, JointsSample, SensorHeader
from modelserver.wire import codec
from modelserver.wire.codec import decode, encode, pack_get_transformation

START_UTIME: Final = 1_700_000_000_000_000
STEP_US, SAMPLES = 20_000, 100
BASE_FRAME: Final = "Raptor:CG"
RUNS: Final = 7
SERVER: Final = ("decode", "step", "encode")
CLIENT: Final = ("ask", "read reply")
BOUND_US, RATIO_BOUND = 60.0, 50.0

_REQUEST, _REPLY = "get_transformation_request_t", "get_transformation_reply_t"
_NUMBERS: Final = struct.Struct(">3q55d")
"""About the numbers of a request and its reply: ids, times, pose, covariance, bounds."""


def load_core(moving: bool) -> tuple[CoreState, list[str], Instant]:
    """Return a core with a new model, the full names of all frames, and the time after the samples.

    With `moving` both nodding axes have samples at 50 Hz.
    """
    model = load_model(RAPTOR / "geometry.yaml")
    state = core.start(CoreSettings(BASE_FRAME), model, None, Instant(0, START_UTIME))
    now = Instant(0, START_UTIME)
    for sample in range(SAMPLES if moving else 0):
        utime = START_UTIME + sample * STEP_US
        now = Instant(sample * STEP_US * 1000, utime)
        angle = 0.3 * math.sin(0.05 * sample)
        joints = tuple(JointSample(name, angle, 0.0004, 0.1, 0.01) for name in model.joints)
        state, _ = core.step(state, JointsSample(SensorHeader(utime, "axes"), joints), now)
    names = [f"{body.name}:{frame.name}" for body in model.bodies for frame in body]
    return state, names, now


def measure(moving: bool, seed: int) -> tuple[dict[str, list[float]], list[bool]]:
    """Return the seconds of each part of each query, every pair once in random order; and which pass a joint."""
    codec._ANSWER_CACHE.clear()
    state, names, now = load_core(moving)
    pairs = list(itertools.product(names, repeat=2))
    random.Random(seed).shuffle(pairs)
    times: dict[str, list[float]] = {part: [] for part in (*SERVER, *CLIENT, "floor")}
    clock = time.perf_counter
    numbers = tuple([0] * 3 + [0.5] * 55)
    through_joint = []
    for number, (interest, reference) in enumerate(pairs):
        begin = clock()
        question = pack_get_transformation(number, "REPLY_BENCHMARK", interest, reference, 0, 0, 0)
        asked = clock()
        request = decode(_REQUEST, question)
        decoded = clock()
        state, outputs = core.step(state, request, now)
        stepped = clock()
        reply = encode(outputs[0].reply)
        encoded = clock()
        decode_pose_reply(reply, interest, reference)
        opened = clock()
        _NUMBERS.unpack(_NUMBERS.pack(*numbers))
        end = clock()
        spent = (decoded - asked, stepped - decoded, encoded - stepped, asked - begin, opened - encoded, end - opened)
        for part, seconds in zip(times, spent, strict=True):
            times[part].append(seconds)
        through_joint.append(outputs[0].reply.answer.transformation.utime != 0)
    return times, through_joint


def quantile(values: Sequence[float], share: float) -> float:
    """Return the `share` quantile of the values."""
    return sorted(values)[min(int(share * len(values)), len(values) - 1)]


def main() -> int:
    holds = True
    for moving in (False, True):
        measure(moving, 0)  # warm up: the interpreter specializes what runs often
        runs = [measure(moving, seed) for seed in range(1, RUNS + 1)]
        print(f"  joints {'moving at 50 Hz' if moving else 'never reported'}; median of {RUNS} runs, us:")
        print(f"    {'':12} {'p50':>7} {'p99':>7}")
        for part in (*SERVER, *CLIENT, "floor"):
            p50, p99 = (statistics.median(quantile(run[part], share) for run, _ in runs) * 1e6 for share in (0.5, 0.99))
            print(f"    {part:12} {p50:7.1f} {p99:7.1f}")
        sums = [
            ([sum(each) for each in zip(*(times[part] for part in SERVER), strict=True)], through_joint)
            for times, through_joint in runs
        ]
        floor = statistics.median(statistics.median(times["floor"]) for times, _ in runs)
        kinds = {
            "any pair": [total for total, _ in sums],
            "rigid pairs": [[each for each, joint in zip(*run, strict=True) if not joint] for run in sums],
            "pairs through joints": [[each for each, joint in zip(*run, strict=True) if joint] for run in sums],
        }
        for kind, totals in kinds.items():
            p50, p99 = (statistics.median(quantile(each, share) for each in totals) for share in (0.5, 0.99))
            print(f"    server, {kind} ({len(totals[0])}): {p50 * 1e6:.1f} us, p99 {p99 * 1e6:.1f} us")
            holds &= print_verdict(f"server, {kind}, p50", p50 * 1e6, BOUND_US, "us")
            holds &= print_verdict(f"server, {kind}, p50 to the floor", p50 / floor, RATIO_BOUND, "x")
    return 0 if holds else 1
