"""Cost of a call of the dynamics, beside Pinocchio's bare call.

Processor time of mass matrix, bias vector, inverse and forward dynamics, as a median of interleaved runs. Within its
bounds: three times the bare call, for a tree of 30 joints with one coordinate each. Beside it: a floating base, whose
rotation vector costs more in Python than a small vehicle in Pinocchio, and a small arm, where the bare call takes less
than a microsecond.
"""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Callable
from itertools import cycle

import numpy as np

from modelserver.dynamics import Dynamics
from modelserver.geometry import Joint, JointType, Model, ModelBuilder
from modelserver.geometry.inertia import RigidInertia
from modelserver.transforms import Pose

BOUND = 3.0
JOINTS = 30
CALLS, RUNS = 200, 21


def make_tree(joints: int) -> Model:
    """Return a tree of bodies with a joint to each but the first."""
    rng = random.Random(1)
    builder = ModelBuilder("tree")
    inertia = RigidInertia(2.0, (0.1, 0.0, 0.2), ((0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))).matrix()
    for body in range(joints + 1):
        draft = builder.add_body(f"B{body}", inertia=inertia)
        for frame in ("In", "Out"):
            draft.add_frame(frame, Pose([rng.uniform(-1, 1) for _ in range(3)], [rng.gauss(0, 1) for _ in range(4)]))
    for body in range(1, joints + 1):
        kind = rng.choice((JointType.REVOLUTE, JointType.PRISMATIC))
        joint = Joint(kind, tuple(rng.gauss(0, 1) for _ in range(3)))
        builder.add_constraint(f"C{body}", f"B{rng.randrange(body)}:Out", f"B{body}:In", joint=joint)
    return builder.build()


def measure(*calls: Callable[[], object]) -> list[float]:
    """Return the median processor time of each call in microseconds; their runs take turns."""
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(RUNS):
        for call, found in zip(calls, times, strict=True):
            begin = time.process_time()
            for _ in range(CALLS):
                call()
            found.append((time.process_time() - begin) / CALLS * 1e6)
    return [statistics.median(each) for each in times]


def compare(title: str, dynamics: Dynamics, states: int) -> float:
    """Print the costs over a number of states that take turns; return the largest ratio."""
    import pinocchio as pin

    n, model = len(dynamics.coordinates), dynamics._model
    data = model.createData()
    given = []
    for q, v, tau in np.random.default_rng(2).uniform(-1.0, 1.0, (states, 3, n)):
        _, q_pin, S = dynamics._configure(q)
        given.append((q, v, tau, q_pin, S @ v, np.linalg.solve(S.T, tau)))
    turns = cycle(given)

    def call_own(name: str) -> Callable[[], object]:
        method = getattr(dynamics, name)
        count = {"mass_matrix": 1, "bias": 2}.get(name, 3)
        return lambda: method(*next(turns)[:count])

    def call_bare(function: Callable[..., object], count: int) -> Callable[[], object]:
        return lambda: function(model, data, *next(turns)[3 : 3 + count])

    worst = 0.0
    for name, bare in (
        ("mass_matrix", call_bare(pin.crba, 1)),
        ("bias", call_bare(pin.nonLinearEffects, 2)),
        ("inverse", call_bare(pin.rnea, 3)),
        ("forward", call_bare(pin.aba, 3)),
    ):
        mine, theirs = measure(call_own(name), bare)
        print(f"{title:34} {name:12} {mine:6.1f} us, bare {theirs:5.1f} us, ratio {mine / theirs:.1f}")
        worst = max(worst, mine / theirs)
    return worst


def main() -> int:
    try:
        import pinocchio  # noqa: F401
    except ImportError:
        print("skipped: pip install 'modelserver[dynamics]'")
        return 77
    model = make_tree(JOINTS)
    worst = compare(f"{JOINTS} joints", Dynamics(model, "fixed"), 2)
    compare(f"{JOINTS} joints, floating, same state", Dynamics(model), 1)
    compare(f"{JOINTS} joints, floating, new states", Dynamics(model), 2)
    compare("4 joints", Dynamics(make_tree(4), "fixed"), 2)
    print(f"worst ratio of {JOINTS} joints on a fixed base: {worst:.1f}, bound {BOUND:g}")
    return int(worst > BOUND)
