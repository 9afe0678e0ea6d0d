"""URDF and libbot2 files in small, to be broken by tests, and models with joints to be written and read back."""

from __future__ import annotations

import math

from hypothesis import strategies as st
from support_formats import names
from support_spatial import axes, poses

from modelserver.geometry import Joint, JointType, Material, Mimic, Model, ModelBuilder, Shape, ShapeKind
from modelserver.geometry.parts import RigidInertia
from modelserver.transforms import Pose

URDF = """\
<?xml version="1.0"?>
<robot name="cart">
  <material name="red">
    <color rgba="1 0 0 1"/>
  </material>
  <link name="cart">
    <inertial>
      <origin xyz="0.1 0 0.2" rpy="0 0 0.5"/>
      <mass value="40"/>
      <inertia ixx="2" ixy="0.1" ixz="0" iyy="3" iyz="0" izz="4"/>
    </inertial>
    <visual name="hull">
      <origin xyz="0 0 0.1"/>
      <geometry>
        <mesh filename="package://cart/hull.dae" scale="1 1 -1"/>
      </geometry>
      <material name="red"/>
    </visual>
    <collision>
      <geometry>
        <box size="1 0.5 0.2"/>
      </geometry>
    </collision>
  </link>
  <link name="mast"/>
  <link name="finger"/>
  <joint name="pan" type="revolute">
    <origin xyz="0.2 0 0.4" rpy="0 0.1 0"/>
    <parent link="cart"/>
    <child link="mast"/>
    <axis xyz="0 0 1"/>
    <limit lower="-1.5" upper="1.5" effort="10" velocity="2"/>
  </joint>
  <joint name="grip" type="prismatic">
    <parent link="mast"/>
    <child link="finger"/>
    <limit lower="0" upper="0.1" effort="10" velocity="0.1"/>
    <mimic joint="pan" multiplier="0.05" offset="0.02"/>
  </joint>
</robot>
"""

BOT_FRAMES = """\
coordinate_frames {
  root_frame = "local";
  body {
    relative_to = "local";
    history = 1000;
    update_channel = "BODY_TO_LOCAL";
    initial_transform {
      translation = [ 1, 2, 3 ];
      quat = [ 1, 0, 0, 0 ];
    }
  }
  laser {
    relative_to = "body";
    initial_transform {
      translation = [ 0.5, 0, 0.25 ];  # meters
      rpy = [ 0, 90, 0 ];
    }
  }
}
"""


def pose_at(model: Model, interest: str, reference: str, values: dict[str, float]) -> Pose:
    """Return where a frame is in another with each coordinate at its value; joints that follow are taken along."""
    route = model.get_kinematic_path(interest, reference)
    positions = []
    for leg in route.joints:
        drive = model.drives[leg.name]
        positions.append(tuple(drive.multiplier * values[name] + drive.offset for name in drive.names))
    return route.compute_pose(positions)


def coordinates_of(model: Model) -> list[str]:
    """Return the names of all coordinates that drive a model."""
    return sorted({name for drive in model.drives.values() for name in drive.names})


texts = st.text(st.characters(exclude_categories=("C", "Z")), min_size=1, max_size=12)
sizes = st.floats(0, 10)
colors = st.tuples(*[st.floats(0, 1)] * 4)
materials = st.builds(Material, texts, st.none() | colors, st.just("") | texts)
_looks = {"name": st.just("") | texts, "material": st.none() | materials}
shapes = st.one_of(
    st.builds(Shape, st.just(ShapeKind.BOX), st.tuples(sizes, sizes, sizes), poses, **_looks),
    st.builds(Shape, st.just(ShapeKind.CYLINDER), st.tuples(sizes, sizes), poses, **_looks),
    st.builds(Shape, st.just(ShapeKind.SPHERE), st.tuples(sizes), poses, **_looks),
    st.builds(Shape, st.just(ShapeKind.MESH), st.tuples(*[st.floats(-5, 5)] * 3), poses, texts, **_looks),
)
colourless = shapes.map(lambda shape: Shape(shape.kind, shape.size, shape.pose, shape.file, shape.name))


@st.composite
def inertias(draw):
    """Return the inertia of a box somewhere, turned somehow: a body that can be."""
    x, y, z = draw(st.tuples(*[st.floats(0.1, 3)] * 3))
    mass = draw(st.floats(0.01, 1000))
    moments = (
        (mass * (y * y + z * z) / 12, 0, 0),
        (0, mass * (x * x + z * z) / 12, 0),
        (0, 0, mass * (x * x + y * y) / 12),
    )
    return RigidInertia.from_moments(mass, draw(poses), moments)


limits = (
    st.none() | st.tuples(st.floats(-3, 0), st.floats(0.1, 3)) | st.sampled_from([(-math.inf, 1.0), (-1.0, math.inf)])
)


@st.composite
def joints(draw, forward=True, leaders=()):
    """Return a joint that URDF can hold; planar and floating ones only where the tree passes them `forward`."""
    kinds = [JointType.FIXED, JointType.REVOLUTE, JointType.REVOLUTE, JointType.PRISMATIC]
    kind = draw(st.sampled_from([*kinds, JointType.PLANAR, JointType.FLOATING] if forward else kinds))
    axis = draw(axes)
    if kind not in (JointType.REVOLUTE, JointType.PRISMATIC):
        return Joint(kind, axis)
    bounds = draw(limits)
    lower, upper = ((), ()) if bounds is None else ((bounds[0],), (bounds[1],))
    rate = draw(st.just(()) | st.tuples(st.floats(0, 5)))
    mimic = None
    if leaders and draw(st.booleans()):
        mimic = Mimic(draw(st.sampled_from(leaders)), draw(st.floats(-3, 3)), draw(st.floats(-1, 1)))
    return Joint(kind, axis, lower, upper, rate, mimic=mimic)


@st.composite
def jointed_models(draw):
    """Return a tree of bodies with frames, joints both ways round, inertias and shapes."""
    builder = ModelBuilder("jointed")
    bodies = draw(st.lists(names, min_size=1, max_size=5, unique=True))
    leaders: list[str] = []
    for number, name in enumerate(bodies):
        inertia = draw(st.none() | inertias())
        body = builder.add_body(name, inertia=None if inertia is None else inertia.matrix())
        body.visuals = tuple(draw(st.lists(shapes, max_size=2)))
        body.collisions = tuple(draw(st.lists(colourless, max_size=2)))
        some_pose = st.just(Pose()) | poses
        for frame in [f"on{each}" for each in range(number + 1, len(bodies))]:
            body.add_frame(frame, draw(some_pose))
        body.add_frame("Origin", draw(some_pose)).add_frame("base", draw(some_pose))
        if number:
            ends = (f"{draw(st.sampled_from(bodies[:number]))}:on{number}", f"{name}:base")
            forward = draw(st.booleans())
            joint = draw(joints(forward, leaders))
            builder.add_constraint(f"c{number}", *(ends if forward else ends[::-1]), draw(some_pose), joint=joint)
            if joint.count == 1:
                leaders.append(f"c{number}")
    return builder.build()


@st.composite
def positions(draw, model):
    """Return a value for each coordinate."""
    return {name: draw(st.floats(-3, 3)) for name in coordinates_of(model)}
