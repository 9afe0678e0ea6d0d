"""Cost of a call of the dynamics, beside Pinocchio's bare call.

Processor time of mass matrix, bias vector, inverse and forward dynamics, as a median of interleaved runs. The bare call
has its arguments in Pinocchio's own coordinates, and Pinocchio's own joint for a floating base. Within its bounds:
three times the bare call, for a tree of 30 joints with one coordinate each on a fixed and on a floating base, in the
same state and in new ones. Beside it two small trees, where the bare call takes a microsecond.
"""

from __future__ import annotations

import random
import statistics
import time
from collections.abc import Callable
from itertools import cycle
from typing import Any

import numpy as np

from modelserver.dynamics import Dynamics
from modelserver.geometry import Joint, JointType, Model, ModelBuilder
from modelserver.geometry.parts import RigidInertia
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


def make_bare_model(dynamics: Dynamics) -> Any:
    """Return Pinocchio's model of the same tree, where a free flyer takes the place of the two joints of the base."""
    import pinocchio as pin

    own, model, base = dynamics._model, pin.Model(), int(dynamics.tree.is_floating)
    for number in range(1 + base, own.njoints):
        is_base = number == 2 and bool(base)
        joint = pin.JointModelFreeFlyer() if is_base else own.joints[number]
        parent = 0 if is_base else own.parents[number] - base
        added = model.addJoint(parent, joint, own.jointPlacements[number], own.names[number])
        model.appendBodyToJoint(added, own.inertias[number], pin.SE3.Identity())
    return model


def compare(title: str, dynamics: Dynamics, states: int) -> float:
    """Print the costs over a number of states that take turns; return the largest ratio."""
    import pinocchio as pin

    model = make_bare_model(dynamics)
    data = model.createData()
    given = np.random.default_rng(2).uniform(-1.0, 1.0, (states, 3, len(dynamics.coordinates)))
    own = cycle([tuple(state) for state in given])
    bare = cycle([(dynamics._configure(state[0])[1], *state[1:]) for state in given])

    def call_own(name: str, count: int) -> Callable[[], object]:
        method = getattr(dynamics, name)
        return lambda: method(*next(own)[:count])

    def call_bare(name: str, count: int) -> Callable[[], object]:
        function = getattr(pin, name)
        return lambda: function(model, data, *next(bare)[:count])

    worst = 0.0
    for name, theirs, count in (
        ("mass_matrix", "crba", 1),
        ("bias", "nonLinearEffects", 2),
        ("inverse", "rnea", 3),
        ("forward", "aba", 3),
    ):
        cost, floor = measure(call_own(name, count), call_bare(theirs, count))
        print(f"{title:34} {name:12} {cost:6.1f} us, bare {floor:5.1f} us, ratio {cost / floor:.1f}")
        worst = max(worst, cost / floor)
    return worst


def main() -> int:
    try:
        import pinocchio  # noqa: F401
    except ImportError:
        print("skipped: pip install 'modelserver[dynamics]'")
        return 77
    model, small = make_tree(JOINTS), make_tree(4)
    fixed = compare(f"{JOINTS} joints", Dynamics(model, "fixed"), 2)
    same = compare(f"{JOINTS} joints, floating, same state", Dynamics(model), 1)
    new = compare(f"{JOINTS} joints, floating, new states", Dynamics(model), 2)
    compare("4 joints", Dynamics(small, "fixed"), 2)
    compare("4 joints, floating, same state", Dynamics(small), 1)
    compare("4 joints, floating, new states", Dynamics(small), 2)
    print(f"worst ratio of {JOINTS} joints: fixed {fixed:.1f}, floating {max(same, new):.1f}, bound {BOUND:g}")
    return int(max(fixed, same, new) > BOUND)
