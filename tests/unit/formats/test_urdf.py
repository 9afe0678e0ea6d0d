"""URDF: what is read, the error for each bad input, and how it is written."""

import math

import pytest
from support_formats import YAML, line_of, only_problem, problems_of, read
from support_urdf import URDF, pose_at

from modelserver.errors import GeometryError, Severity
from modelserver.formats import save_model
from modelserver.formats.urdf import list_link_names
from modelserver.geometry import Joint, JointType, Material, Mimic, ModelBuilder, Shape, ShapeKind, Sigma
from modelserver.transforms import Pose

LIMIT = '<limit lower="-1.5" upper="1.5" effort="10" velocity="2"/>'
MIMIC = '<mimic joint="pan" multiplier="0.05" offset="0.02"/>'
GRIP = '<joint name="grip" type="prismatic">'


def test_links_are_bodies_and_joints_constraints_root_first():
    model = read(URDF)
    assert model.name == "cart"
    assert model.get_body_list() == ["cart", "mast", "finger"]
    assert model.get_body_frame_list("cart") == ["Origin", "pan"]
    assert [(each.name, each.from_, each.to) for each in model.constraints] == [
        ("pan", "cart:pan", "mast:Origin"),
        ("grip", "mast:grip", "finger:Origin"),
    ]
    pan, grip = model.constraints
    assert pan.pose.is_close(Pose.from_rpy((0.2, 0, 0.4), 0, 0.1, 0))
    assert pan.joint == Joint(JointType.REVOLUTE, (0, 0, 1), (-1.5,), (1.5,), (2.0,))
    assert grip.joint.axis == (1.0, 0.0, 0.0)
    assert grip.joint.mimic == Mimic("pan", 0.05, 0.02)
    assert [problem.severity for problem in model.problems] == [Severity.NOTE]
    assert "effort limits of 2 joints ignored" in model.problems[0].message


def test_the_root_comes_first_wherever_it_stands():
    top = URDF.index('  <link name="mast"/>'), URDF.index('  <joint name="pan"')
    links = URDF[top[0] : top[1]]
    text = URDF.replace(links, "").replace('  <link name="cart">', links + '  <link name="cart">')
    assert read(text).get_body_list() == ["cart", "mast", "finger"]


def test_a_joint_that_follows_moves_with_its_leader():
    place = pose_at(read(URDF), "finger:Origin", "mast:Origin", {"pan": 0.6})
    assert place.is_close(Pose((0.05 * 0.6 + 0.02, 0, 0)))


def test_mass_center_and_shapes_are_read():
    body = read(URDF).body("cart")
    assert body.mass == pytest.approx(40)
    assert body.center_of_mass == pytest.approx((0.1, 0, 0.2))
    red = Material("red", (1, 0, 0, 1))
    hull = Shape(ShapeKind.MESH, (1, 1, -1), Pose((0, 0, 0.1)), "package://cart/hull.dae", "hull", red)
    assert body.visuals == (hull,)
    assert body.collisions == (Shape(ShapeKind.BOX, (1, 0.5, 0.2)),)
    assert read(URDF).body("mast").mass is None


@pytest.mark.parametrize(
    ("kind", "limit", "wanted"),
    [
        ("continuous", "", Joint(JointType.REVOLUTE, (1, 0, 0))),
        ("continuous", '<limit effort="1" velocity="3"/>', Joint(JointType.REVOLUTE, (1, 0, 0), rate_limit=(3,))),
        (
            "prismatic",
            '<limit lower="-1e9" upper="1e9" effort="1" velocity="1e9"/>',
            Joint(JointType.PRISMATIC, (1, 0, 0)),
        ),
        ("revolute", '<limit upper="2" velocity="1"/>', Joint(JointType.REVOLUTE, (1, 0, 0), (0,), (2,), (1,))),
        (
            "revolute",
            '<limit lower="-1e10" upper="2"/>',
            Joint(JointType.REVOLUTE, (1, 0, 0), (-math.inf,), (2,)),
        ),
        ("planar", "", Joint(JointType.PLANAR, (1, 0, 0))),
        ("floating", '<limit velocity="1" effort="0"/>', Joint(JointType.FLOATING)),
        ("fixed", '<axis xyz="0 0 0"/>', Joint()),
    ],
)
def test_each_type_of_joint_is_one_of_the_models(kind, limit, wanted):
    inside = f'<joint name="j" type="{kind}"><parent link="a"/><child link="b"/>{limit}</joint>'
    model = read(f'<robot name="r"><link name="a"/><link name="b"/>{inside}</robot>')
    assert model.constraints[0].joint == wanted


@pytest.mark.parametrize(
    ("old", "new", "message", "fix", "element"),
    [
        ('<parent link="cart"/>', '<parent link="carrt"/>', "parent names link 'carrt'", "write cart", "joint pan"),
        ('<parent link="cart"/>', "", "<parent> is missing", '<parent link="..."/>', "joint pan"),
        ('<child link="mast"/>', "<child/>", "<child> has no link", "link=", "joint pan"),
        ('type="revolute"', 'type="revolut"', "type 'revolut' is not known", "write revolute", "joint pan"),
        ('type="revolute"', "", "<joint> has no type", "one of revolute", "joint pan"),
        (LIMIT, "", "a revolute joint needs a <limit>", 'type="continuous"', "joint pan"),
        ('upper="1.5"', 'upper="-2"', "the limits are reversed", "lower below upper", "joint pan"),
        ('lower="-1.5"', 'lower="nan"', "lower: 'nan' is not a finite number", "lower=", "joint pan"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "not all 0", "direction", "joint pan"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 1"/>', "xyz has 2 numbers, not 3", "xyz=", "joint pan"),
        ('xyz="0.2 0 0.4"', 'xyz="0.2, 0, 0.4"', "decimals take a point", "xyz=", "joint pan"),
        ('xyz="0.2 0 0.4"', 'xyz="0.2 0 inf"', "'inf' is not a finite number", "xyz=", "joint pan"),
        ('xyz="0.2 0 0.4"', 'xyz="0.2 0 4e12"', "out of reach", "meters", "joint pan"),
        (MIMIC, MIMIC.replace("pan", "pam"), "its joint follows 'pam'", "write pan", "joint grip"),
        (MIMIC, MIMIC.replace("pan", "grip"), "its joint follows itself", "remove mimic", "joint grip"),
        (MIMIC, MIMIC.replace("0.05", "x"), "'x' is not a number", "multiplier=", "joint grip"),
        (GRIP, GRIP.replace("prismatic", "floating"), "has several coordinates", "remove <mimic>", "joint grip"),
        (GRIP, GRIP.replace("grip", "pan"), "joint pan is defined twice (first on line", "rename", "joint pan"),
        ('<link name="finger"/>', '<link name="mast"/>', "link mast is defined twice", "rename", "link mast"),
        ('<link name="finger"/>', "<link/>", "the name is empty", "rename", "link ''"),
        ('<link name="finger"/>', '<link name="a:b"/>', "a name has no colon", "rename", "link a:b"),
        ('<link name="finger"/>', '<link name="a b"/>', "a name has no white space", "rename", "link a b"),
        ('<link name="finger"/>', '<link name="World"/>', "this name is reserved", "rename", "link World"),
        (GRIP, GRIP.replace("grip", "a b"), "a name has no white space", "rename", "joint a b"),
        ('<child link="finger"/>', '<child link="mast"/>', "link mast has two parents", "one joint", "joint grip"),
        ('<parent link="cart"/>', '<parent link="finger"/>', "links form a cycle", "outside", "joint"),
        (
            '<link name="finger"/>',
            '<link name="finger"/>\n<link name="lamp"/>',
            "2 root links",
            "add a joint",
            "link lamp",
        ),
        ('<mass value="40"/>', "", "<inertial> has no <mass>", "kilograms", "link cart, inertial"),
        ('value="40"', 'value="1e200"', "out of reach", "slip", "link cart, inertial"),
        ('ixx="2" ', "", "<inertia> has no ixx", "ixx=", "link cart, inertial"),
        ('<box size="1 0.5 0.2"/>', '<box size="1 -1 1"/>', "not negative", "remove the shape", "link cart, collision"),
        ('<box size="1 0.5 0.2"/>', "<box/>", "<box> has no size", "size=", "link cart, collision"),
        ('filename="package://cart/hull.dae" ', "", "a mesh's file is missing", "remove", "link cart, visual"),
        ('<link name="mast"/>', "<xacro:wheel/>", "<xacro:wheel> is to be replaced", "run xacro first", ""),
        ('xyz="0.2 0 0.4"', 'xyz="${x} 0 0.4"', "'${x} 0 0.4' is to be replaced", "run xacro first", ""),
    ],
)
def test_a_bad_file_has_an_error_with_place_and_fix(old, new, message, fix, element):
    text = URDF.replace("<robot ", '<robot xmlns:xacro="http://ros.org/wiki/xacro" ').replace(old, new, 1)
    assert old in URDF
    errors = [each for each in problems_of(text) if each.severity is Severity.ERROR]
    problem = next(each for each in errors if message in each.message)
    assert fix in problem.fix
    assert element in problem.element
    assert problem.line > 0
    assert problem.file == "file"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<link name="mast"/>', '<link name="mast"/><lnk/>', "unknown element <lnk>; ignored"),
        ('value="40"', 'value="0"', "the mass is 0 kg; it must be positive; ignored"),
        ('izz="4"', 'izz="40"', "none can be greater than the sum of the other two"),
        ('lower="-1.5" upper="1.5" ', "", "the joint cannot move"),
        ('<box size="1 0.5 0.2"/>', "<bax/>", "geometry bax is not known; ignored"),
        ('rpy="0 0.1 0"', 'rpj="0 0.1 0"', "unknown attribute rpj"),
        ("<geometry>\n        <box", "<geometri>\n        <box", "XML"),
        ("<material name", '<material name="red"/><material name', "material red is defined twice; the first is used"),
    ],
)
def test_what_does_not_matter_is_a_warning(old, new, message):
    text = URDF.replace(old, new, 1)
    problem = only_problem(text, Severity.ERROR if message == "XML" else Severity.WARNING)
    assert message in problem.message
    assert problem.fix


def test_every_error_has_the_line_of_its_element():
    text = URDF.replace('<child link="finger"/>', '<child link="fingre"/>')
    problem = only_problem(text)
    assert problem.line == line_of(text, "fingre")
    assert problem.nearest == ("finger",)


def test_nothing_is_repaired_of_a_broken_tree():
    with pytest.raises(GeometryError, match="two parents"):
        read(URDF.replace('<child link="finger"/>', '<child link="mast"/>'), repair=True)


def test_frames_become_links_and_unsupported_features_are_listed():
    builder = ModelBuilder("c\nart", "a cart")
    cart = builder.add_body("Cart", pose=Pose((1, 0, 0)), inertia=((1.0,) * 6,) * 6)
    cart.add_frame("Origin").add_frame("Tail", Pose((-1, 0, 0)), sigma=Sigma()).add_frame("Top", Pose((0, 0, 1)))
    builder.add_body("Ball").add_frame("Foot", Pose((0, 0, -0.1)))
    builder.add_body("Lamp").add_frame("Origin")
    builder.add_constraint("Hip", "Cart:Top", "Ball:Foot", joint=Joint(JointType.SPHERICAL))
    builder.add_body("Arm").add_frame("In", Pose((0.5, 0, 0))).add_frame("Out")
    joint = Joint(JointType.REVOLUTE, sigma=(0.1,), mimic=Mimic("Slide"))
    builder.add_constraint("Turn", "Cart:Tail", "Arm:In", joint=joint)
    builder.add_body("Tray").add_frame("Origin")
    builder.add_constraint("Slide", "Tray:Origin", "Arm:Out", joint=Joint(JointType.PRISMATIC, default=(0.5,)))
    model = builder.build()
    saved = save_model(model, "urdf")
    lost = "; ".join(saved.unsupported)
    for message in (
        "1 descriptions",
        "1 sigmas",
        "the inertia of Cart",
        "the own transform of Cart",
        "the motion of Hip; written as fixed at the default position",
        "the default position of Slide",
        "the sigma of the position of Turn",
        "Cart:Tail as Cart.Tail, Cart:Top as Cart.Top, Ball:Foot as Ball.Foot, Arm:In as Arm.In, Arm:Out as Arm.Out",
        "bodies that no constraints join to Cart: Lamp",
        "control characters in the model's name",
    ):
        assert message in lost
    again = read(saved.text)
    assert again.name == "c art"
    place = {full: f"{link}:Origin" for full, link in list_link_names(model).items()}
    values = {"Slide": 0.25, "Hip.rx": 0.0, "Hip.ry": 0.0, "Hip.rz": 0.0}
    for a in place:
        wanted = pose_at(model, a, "Cart:Origin", values)
        assert pose_at(again, place[a], "Cart:Origin", values).is_close(wanted), a


def test_a_loop_and_a_follower_of_what_is_not_written_are_listed():
    builder = ModelBuilder()
    for name in "ABC":
        builder.add_body(name).add_frame("p").add_frame("q")
    builder.add_constraint("ab", "A:q", "B:p", joint=Joint(JointType.REVOLUTE, mimic=Mimic("bc")))
    builder.add_constraint("ca", "C:q", "A:p")
    builder.add_constraint("bc", "B:q", "C:p", joint=Joint(JointType.REVOLUTE))
    saved = save_model(builder.build(), "urdf")
    assert any("constraints that close a loop: bc" in loss for loss in saved.unsupported)
    assert any("which joint ab follows" in loss for loss in saved.unsupported)
    assert read(saved.text).constraints[0].joint.mimic is None


def test_a_format_without_joints_and_shapes_lists_them_and_has_the_default_position():
    text = URDF.replace('lower="-1.5"', 'lower="0.5"')
    model = read(text)
    saved = save_model(model, "miro")
    lost = "; ".join(saved.unsupported)
    assert "the motion of 2 joints, written as fixed at the default position: pan, grip" in lost
    assert "the visuals of 1 body: cart" in lost
    assert "the collisions of 1 body: cart" in lost
    wanted = model.get_transformation("mast:Origin", "cart:Origin").pose
    assert read(saved.text).get_transformation("mast:Origin", "cart:Origin").pose.is_close(wanted)


def test_a_file_of_yaml_becomes_urdf():
    saved = save_model(read(YAML), "urdf")
    assert saved.unsupported == ("frames but as links of their own; written Cart:Mast as Cart.Mast",)
    assert read(saved.text).get_body_list() == ["Cart", "Camera", "Cart.Mast"]


ROBOT = '<robot name="r">\n<link name="a"/>\n<link name="b"/>\n{}<joint name="j" type="fixed"><parent link="a"/>'
ROBOT += '<child link="b"/><origin xyz="0.1 0 0.2"/></joint>\n</robot>\n'


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ('\n<?xml version="1.0"?>\n' + ROBOT.format(""), 2),
        ('<!-- made by hand -->\n<?xml version="1.0"?>\n' + ROBOT.format(""), 2),
        ('<?xml version="0.0" ?>\n' + ROBOT.format(""), 1),
        ('<?xml version="1.0" encoding="utf8mb4"?>\n' + ROBOT.format(""), 1),
        (ROBOT.format('<gazebo><sensor:camera name="c"/></gazebo>\n'), 4),
        (ROBOT.format("<!-- a -- b --->\n"), 4),
        (ROBOT.format('<gazebo note="a & b &nbsp; c < d"/>\n'), 4),
        (ROBOT.format("<!-- \u00e9 -->\n").encode("latin-1"), 4),
        (ROBOT.format("") + "done\n", 6),
    ],
    ids=["blank", "comment", "version", "encoding", "prefix", "hyphens", "ampersand", "latin_1", "text_after"],
)
def test_a_file_that_ros_reads_is_read_with_a_warning(content, line):
    model = read(content)
    assert pose_at(model, "b:Origin", "a:Origin", {}).is_close(Pose((0.1, 0, 0.2)))
    (problem,) = [each for each in model.problems if each.severity is Severity.WARNING]
    assert "not well-formed" in problem.message
    assert "as ROS does" in problem.message
    assert problem.line == line


@pytest.mark.parametrize(
    "flaw", ['<link name="c">', "<link name=c/>", '<link name="c" name="d"/>', '<link name="c"a="b"/>']
)
def test_a_file_that_ros_rejects_is_an_error(flaw):
    assert "not well-formed" in only_problem(ROBOT.format(flaw)).message


def test_the_source_of_a_file_is_no_file_with_an_undeclared_prefix():
    *_, last = problems_of(ROBOT.format('<xacro:include filename="a.xacro"/>'))
    assert last.severity is Severity.ERROR
    assert "<xacro:include>" in last.message
    assert "run xacro first" in last.fix


@pytest.mark.parametrize(
    ("mass", "moments", "message"),
    [
        ("0.5", "0.001 -0.0002 0.001", "no body has a negative one"),
        ("0.5", "-1 -1 -1", "no body has a negative one"),
        ("-0.5", "1 1 1", "the mass is -0.5 kg"),
    ],
)
def test_an_inertia_that_no_body_can_have_is_an_error_that_names_the_link(mass, moments, message):
    xx, yy, zz = moments.split()
    inertia = f'<inertia ixx="{xx}" ixy="0" ixz="0" iyy="{yy}" iyz="0" izz="{zz}"/>'
    link = f'<link name="b"><inertial><mass value="{mass}"/>{inertia}</inertial></link>'
    problem = only_problem(ROBOT.format("").replace('<link name="b"/>', link))
    assert problem.severity is Severity.ERROR
    assert message in problem.message
    assert "link b" in problem.element


def test_a_negative_moment_in_yaml_or_in_a_program_is_an_error():
    rows = [[1.0 if a == b else 0.0 for a in range(6)] for b in range(6)]
    rows[4][4] = -0.1
    builder = ModelBuilder()
    builder.add_body("Arm", inertia=tuple(map(tuple, rows))).add_frame("Origin")
    with pytest.raises(GeometryError, match=r"'Arm'.*no body has a negative one"):
        builder.build()


@pytest.mark.parametrize("angle", ["90", "-45", "5", "6.5", "1e3"])
def test_angles_that_look_like_degrees_are_a_warning(angle):
    model = read(ROBOT.format("").replace('xyz="0.1 0 0.2"', f'rpy="0 0 {angle}"'))
    (problem,) = [each for each in model.problems if each.severity is Severity.WARNING]
    assert f"{float(angle):g} rad looks like degrees" in problem.message
    assert f"write {math.radians(float(angle)):.6g}" in problem.fix


@pytest.mark.parametrize("angle", ["3", "3.14159", "-4.712389", "6.2831853", "6.28"])
def test_angles_within_a_turn_are_none(angle):
    model = read(ROBOT.format("").replace('xyz="0.1 0 0.2"', f'rpy="0 0 {angle}"'))
    assert [each for each in model.problems if each.severity is Severity.WARNING] == []
