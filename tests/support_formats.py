"""Geometry files in small, to be broken by tests, and models to be written and read back."""

from __future__ import annotations

from itertools import product

from hypothesis import strategies as st
from support_joints import joints
from support_spatial import poses

from modelserver.errors import GeometryError, Severity
from modelserver.formats import parse_model
from modelserver.geometry import Model, ModelBuilder, Sigma

IDENTITY_ROWS = ("1 0 0 0", "0 1 0 0", "0 0 1 0")


def rows(values=IDENTITY_ROWS, name="HTransform"):
    inside = "\n".join(f'<parameter name="Row{n}" value="{row}"/>' for n, row in enumerate(values, 1))
    return f'<parameter name="{name}">\n{inside}\n</parameter>'


def miro_frame(name, transform=None):
    transform = rows() if transform is None else transform
    return f'<parameter>\n<parameter name="FrameName" value="{name}"/>\n{transform}\n</parameter>'


def miro_body(name, *frames):
    inside = "\n".join(frames or (miro_frame("Origin"),))
    return (
        f'<parameter>\n<parameter name="BodyName" value="{name}"/>\n'
        f'<parameter name="Frames">\n{inside}\n</parameter>\n</parameter>'
    )


def miro_constraint(name, from_, to):
    return (
        f'<parameter>\n<parameter name="ConstraintName" value="{name}"/>\n'
        f'<parameter name="From" value="{from_}"/>\n<parameter name="To" value="{to}"/>\n{rows()}\n</parameter>'
    )


def miro(bodies=None, constraints=None):
    """Return a file of two bodies, Cart and Camera, joined; or of those given."""
    bodies = (
        [miro_body("Cart", miro_frame("Origin"), miro_frame("Mast")), miro_body("Camera")] if bodies is None else bodies
    )
    constraints = [miro_constraint("CameraFixed", "Cart:Mast", "Camera:Origin")] if constraints is None else constraints
    lists = "".join(
        f'<parameter name="{name}">\n' + "\n".join(inside) + "\n</parameter>\n"
        for name, inside in (("BodyList", bodies), ("ConstraintList", constraints))
    )
    return f'<config>\n<section name="Geometry">\n{lists}</section>\n</config>\n'


def tree_frame(name, parent="", **values):
    inside = "".join(f'<parameter value="{value}" name="{key}"/>\n' for key, value in values.items())
    return (
        f'<instance type="rapid::FrameRpyParameters" name="{name}">\n'
        f'<parameter value="{parent}" name="Parent"/>\n{inside}</instance>\n'
    )


def tree(*frames):
    return f'<!DOCTYPE MiroConfigDocument>\n<config>\n<section name="Frames">\n{"".join(frames)}</section>\n</config>\n'


YAML = """\
modelserver: geometry/1
bodies:
  Cart:
    frames:
      Origin: {}
      Mast: {xyz: [0.2, 0, 1.1], rpy_deg: [0, -10, 0]}
  Camera:
    frames:
      Origin: {}
constraints:
  CameraFixed:
    from: Cart:Mast
    to: Camera:Origin
    xyz: [0, 0, 0.1]
"""


def read(text, **options):
    return parse_model(text.encode() if isinstance(text, str) else text, "file", **options)


def problems_of(text, **options):
    """Return the problems of a file, whether it loads or not."""
    try:
        return read(text, **options).problems
    except GeometryError as error:
        return error.problems


def only_problem(text, severity=Severity.ERROR, **options):
    """Return the one error or warning of a file."""
    found = [problem for problem in problems_of(text, **options) if problem.severity is not Severity.NOTE]
    assert [problem.severity for problem in found] == [severity], found
    return found[0]


def line_of(text, piece):
    """Return the number of the line, counted from 1, in which `piece` first stands."""
    return text[: text.index(piece)].count("\n") + 1


def all_frames(model):
    return [f"{body.name}:{frame.name}" for body in model.bodies for frame in body]


def assert_same_transforms(one: Model, other: Model, tolerance=1e-12):
    """Compare every pair of frames: position to `tolerance` meters, rotation to `tolerance` radians."""
    assert all_frames(one) == all_frames(other)
    for a, b in product(all_frames(one), repeat=2):
        moved, turned = one.get_transformation(a, b).pose.distance(other.get_transformation(a, b).pose)
        assert moved <= tolerance, (a, b)
        assert turned <= tolerance, (a, b)


_letters = st.characters(exclude_categories=("C", "Z"), exclude_characters=":")
names = st.one_of(
    st.sampled_from(
        ("Origin", "null", "on", "~", "12", "1e3", "-", "$MRN", "#a", "[x]", "{y", "*z", "&w", "<<", '"q"')
    ),
    st.text(_letters, min_size=1, max_size=8),
).filter(lambda name: name not in ("World", "Odom"))
descriptions = st.one_of(st.just(""), st.text(max_size=30).map(str.strip))
deviations = st.one_of(st.just(0.0), st.floats(0, 10))
sigmas = st.one_of(st.none(), st.builds(Sigma, st.tuples(*[deviations] * 3), st.tuples(*[deviations] * 3)))


@st.composite
def models(draw):
    """Return a model whose bodies all hang on the first, so that every pair of frames has an answer; some by joints."""
    builder = ModelBuilder(draw(descriptions), draw(descriptions))
    bodies = draw(st.lists(names, min_size=1, max_size=4, unique=True))
    leaders: list[str] = []
    inertia = st.none() | st.just(tuple(tuple(float(6 * i + j) / 3 for j in range(6)) for i in range(6)))
    for number, name in enumerate(bodies):
        body = builder.add_body(name, draw(descriptions), draw(st.none() | poses), draw(inertia))
        frames = draw(st.lists(names, min_size=1, max_size=3, unique=True))
        for frame in [*frames, *(f"on{each}" for each in range(number + 1, len(bodies))), "base"]:
            body.add_frame(frame, draw(poses), draw(descriptions), draw(sigmas))
        if number:
            parent = draw(st.sampled_from(bodies[:number]))
            joint = draw(joints(leaders))
            if joint.count == 1:
                leaders.append(f"c{number}")
            ends = (f"{parent}:on{number}", f"{name}:base")
            builder.add_constraint(f"c{number}", *ends, draw(poses), draw(descriptions), draw(sigmas), joint)
    return builder.build()
