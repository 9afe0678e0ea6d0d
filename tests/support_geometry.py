"""Test models, and searches implemented independently of the package's."""

from __future__ import annotations

import random

import numpy as np

from modelserver.geometry import Model, ModelBuilder, Sigma
from modelserver.transforms import Pose


def random_pose(rng: random.Random) -> Pose:
    return Pose([rng.uniform(-2, 2) for _ in range(3)], [rng.gauss(0, 1) for _ in range(4)])


def random_sigma(rng: random.Random, size: float = 1e-4) -> Sigma:
    return Sigma(
        tuple(rng.uniform(0.2, 1) * size for _ in range(3)), tuple(rng.uniform(0.2, 1) * size for _ in range(3))
    )


def random_builder(rng: random.Random, bodies: int, extra: int = 0, assemblies: int = 1, sigmas=False) -> ModelBuilder:
    """Return a builder of a random tree of bodies, with `extra` constraints that close loops.

    Frames that carry constraints are mixed with free ones, and stand in random order in their bodies.
    """
    joints = [(rng.choice(range(body % assemblies, body, assemblies)), body) for body in range(assemblies, bodies)]
    for _ in range(extra):
        a, b = rng.sample(range(bodies), 2)
        if (a - b) % assemblies == 0:
            joints.append((a, b))
    frames = {body: ["Free0", "Free1"][: rng.choice((1, 2))] for body in range(bodies)}
    ends = []
    for number, (a, b) in enumerate(joints):
        if rng.random() < 0.5:
            a, b = b, a
        frames[a].append(f"From{number}")
        frames[b].append(f"To{number}")
        ends.append((f"B{a}:From{number}", f"B{b}:To{number}"))
    builder = ModelBuilder("random")
    for body in range(bodies):
        rng.shuffle(frames[body])
        draft = builder.add_body(f"B{body}")
        for frame in frames[body]:
            draft.add_frame(frame, random_pose(rng), sigma=random_sigma(rng) if sigmas else None)
    for number, (start, end) in enumerate(ends):
        builder.add_constraint(f"C{number}", start, end, random_pose(rng), sigma=random_sigma(rng) if sigmas else None)
    return builder


def chain(count: int) -> ModelBuilder:
    """Return a builder of bodies B0, B1, ... in a row, each with frames In and Out."""
    builder = ModelBuilder("chain")
    for number in range(count):
        body = builder.add_body(f"B{number}")
        body.add_frame("In", Pose.from_rpy((0.1, 0.0, 0.0), 0.0, 0.1, 0.0))
        body.add_frame("Out", Pose.from_rpy((0.2, 0.1, 0.0), 0.0, 0.0, 0.3))
    for number in range(count - 1):
        builder.add_constraint(f"C{number}", f"B{number}:Out", f"B{number + 1}:In", Pose((0.0, 0.0, 0.01)))
    return builder


def star(count: int) -> ModelBuilder:
    """Return a builder of one hub with half of `count` frames, and a device on each, with one frame."""
    builder = ModelBuilder("star")
    hub = builder.add_body("Hub")
    for number in range(count // 2):
        hub.add_frame(f"Mount{number:05d}", Pose.from_rpy((0.01 * number, 0.2, 0.3), 0.1, 0.2, 0.3 * number))
    for number in range(count // 2):
        builder.add_body(f"Device{number:05d}").add_frame("Origin", Pose((0.1, 0.2, 0.3)))
        builder.add_constraint(f"C{number}", f"Hub:Mount{number:05d}", f"Device{number:05d}:Origin")
    return builder


def all_frames(model: Model) -> list[str]:
    return [f"{body.name}:{frame.name}" for body in model.bodies for frame in body]


def other_ends(model: Model) -> dict[str, str]:
    """Return for each constrained frame the one at the other end."""
    ends = {constraint.from_: constraint.to for constraint in model.constraints}
    return ends | {there: here for here, there in ends.items()}


def body_distances(model: Model) -> np.ndarray:
    """Return how many constraints lie between any two bodies, inf where none does (Floyd and Warshall)."""
    index = {body.name: number for number, body in enumerate(model.bodies)}
    d = np.full((len(index), len(index)), np.inf)
    np.fill_diagonal(d, 0)
    for constraint in model.constraints:
        a, b = index[constraint.from_.split(":")[0]], index[constraint.to.split(":")[0]]
        d[a, b] = d[b, a] = min(1, d[a, b])
    for k in range(len(index)):
        d = np.minimum(d, d[:, k : k + 1] + d[k : k + 1, :])
    return d


def report_depth_first(model: Model, frame_of_reference: str, frame_of_interest: str) -> list[str] | None:
    """Return the frames on the Path stack when the report's search (4.6.2) finds its target, None where it does not.

    The text, clause by clause: "Starting at the B_R:F_R vertex, the search compares B_i:F_j in L_iF against
    the B_I:F_I. Finding no match, the search will examine the next frame unless the frame is constrained. In
    this case it pushes B_i:F_j onto a Path stack, crosses the constraint, and examines the attached frame. If
    a B_i:F_j matches any in Path, a cycle exists and the search examines the next branch, popping Path as
    necessary. The search continues recursively until B_I:F_I is found."
    """
    attached = other_ends(model)
    listed = {body.name: [f"{body.name}:{frame.name}" for frame in body] for body in model.bodies}
    path: list[str] = []

    def search(vertex: str) -> bool:
        if vertex == frame_of_interest:
            return True
        for frame in listed[vertex.split(":")[0]]:
            if frame == frame_of_interest:
                return True
            if frame not in attached or frame in path:
                continue
            path.append(frame)
            if attached[frame] not in path and search(attached[frame]):
                return True
            path.pop()
        return False

    return path if search(frame_of_reference) else None


def product_along(model: Model, path: list[tuple[str, str]], frame_of_interest: str, frame_of_reference: str):
    """Return the 4x4 product of eq. 12 over `path`, pairs of frames at each crossing, by numpy alone."""
    A = {f"{body.name}:{frame.name}": frame.pose.matrix for body in model.bodies for frame in body}
    T = {(c.from_, c.to): c.pose.matrix for c in model.constraints}
    here, product = frame_of_reference, np.eye(4)
    for near, far in path:
        product = product @ np.linalg.inv(A[here]) @ A[near]
        product = product @ (T[near, far] if (near, far) in T else np.linalg.inv(T[far, near]))
        here = far
    return product @ np.linalg.inv(A[here]) @ A[frame_of_interest]
