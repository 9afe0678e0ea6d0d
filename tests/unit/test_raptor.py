"""The report's vehicle: every pair of frames three ways, eq. 13 by hand, and the equality of its two files."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from modelserver.config.vehicle_file import load_config
from modelserver.formats import check_file, load_model
from modelserver.geometry import JointType, Model, Search, Sigma
from modelserver.geometry.joint import FIXED
from modelserver.transforms import Pose

ROOT = Path(__file__).resolve().parents[2]
RAPTOR = ROOT / "config" / "raptor"
FILES = ("geometry.xml", "geometry.yaml")


@pytest.fixture(scope="module", params=FILES)
def raptor(request) -> Model:
    return load_model(RAPTOR / request.param)


# --- an implementation of its own, from the XML to the matrices ---------------------------------------------


def values(element):
    return {child.get("name"): child for child in element}


def matrix(element):
    rows = values(element)
    m = np.eye(4)
    for row in range(3):
        m[row] = [float(number) for number in rows[f"Row{row + 1}"].get("value").split()]
    return m


def nearest(m):
    """Return the rotation nearest to a rounded one."""
    U, _, Vt = np.linalg.svd(m[:3, :3])
    corrected = m.copy()
    corrected[:3, :3] = U @ Vt
    return corrected


@pytest.fixture(scope="module")
def plain():
    """Frames by body and name, and constraints, as matrices straight from the XML."""
    frames, constraints = {}, []
    for parameter in ElementTree.parse(RAPTOR / "geometry.xml").getroot().iter("parameter"):
        inside = values(parameter)
        if "BodyName" in inside:
            body = inside["BodyName"].get("value")
            for frame in inside["Frames"]:
                parts = values(frame)
                frames[body, parts["FrameName"].get("value")] = nearest(matrix(parts["HTransform"]))
        if "ConstraintName" in inside:
            ends = [tuple(inside[end].get("value").split(":")) for end in ("From", "To")]
            constraints.append((*ends, nearest(matrix(inside["HTransform"]))))
    return frames, constraints


@pytest.fixture(scope="module")
def from_origins(plain):
    """Where each body's origin is in each other's: spread over the graph from every body in turn."""
    frames, constraints = plain
    steps = []
    for start, end, m in constraints:
        X = frames[start] @ m @ np.linalg.inv(frames[end])
        steps += [(start[0], end[0], X), (end[0], start[0], np.linalg.inv(X))]
    placed = {}
    for root in dict.fromkeys(body for body, _ in frames):
        known = {root: np.eye(4)}
        while True:
            fresh = {to: known[at] @ X for at, to, X in steps if at in known and to not in known}
            if not fresh:
                break
            known.update(fresh)
        placed[root] = known
    return placed


# --- all pairs ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_pair_of_frames_agrees_between_both_searches_the_answer_and_a_numpy_product(raptor, plain, from_origins):
    frames, _ = plain
    names = [f"{body.name}:{frame.name}" for body in raptor.bodies for frame in body]
    assert names == [f"{body}:{frame}" for body, frame in frames]
    for interest, reference in product(frames, repeat=2):
        foi, foreign = ":".join(interest), ":".join(reference)
        X = np.linalg.inv(frames[reference]) @ from_origins[reference[0]][interest[0]] @ frames[interest]
        answers = [raptor.get_transformation(foi, foreign)]
        answers += [raptor.compose_path(raptor.find_path(foi, foreign, search), foi, foreign) for search in Search]
        for answer in answers:
            assert np.abs(answer.matrix - X).max() <= 1e-12, f"{foi} in {foreign}"


def test_every_body_is_traced_to_the_root(raptor):
    assert raptor.root.name == "Raptor"
    assert len(raptor.assemblies) == 1
    assert len(raptor.constraints) == len(raptor.bodies) - 1


# --- eq. 13 -------------------------------------------------------------------------------------------------


def test_equation_13_by_hand(raptor):
    """R:O to D:I through the cabin front rail and the front nodding SICK, sense by sense (report 4.6.3)."""
    c, s = np.cos(np.radians(12.0)), np.sin(np.radians(12.0))
    RO_CFRC = np.array([[c, 0, s, 1.8], [0, 1, 0, 0.6], [-s, 0, c, 1.22], [0, 0, 0, 1]])
    CFRC_BPCtr = np.eye(4)
    FO_BPCtr = np.eye(4)
    FO_BPC = np.array([[1, 0, 0, -0.133], [0, 1, 0, -0.135], [0, 0, 1, 0], [0, 0, 0, 1]])
    BPC_MPC = np.array([[1, 0, 0, 0.339], [0, 1, 0, 0.007], [0, 0, 1, 0.34], [0, 0, 0, 1]])
    DO_MPC = np.eye(4)
    # the four printed digits, brought to length 1
    u, v = np.array((0.9441, 0.3297)) / np.hypot(0.9441, 0.3297)
    DO_DI = np.array([[u, 0, -v, 0.093], [0, 1, 0, 0.072], [v, 0, u, 0.093], [0, 0, 0, 1]])
    X = RO_CFRC @ CFRC_BPCtr @ np.linalg.inv(FO_BPCtr) @ FO_BPC @ BPC_MPC @ np.linalg.inv(DO_MPC) @ DO_DI

    interest, reference = "Digiclops:ImagePlane", "Raptor:Origin"
    np.testing.assert_allclose(raptor.get_transformation(interest, reference).matrix, X, rtol=0, atol=1e-12)
    for search in Search:
        path = raptor.find_path(interest, reference, search)
        assert [(step.near_frame, step.far_frame) for step in path] == [
            ("Raptor:CabFrontRailCenter", "FrontNoddingSICK:BottomPlateCenter"),
            ("FrontNoddingSICK:BottomPlateCorner", "Digiclops:MountingPlateCorner"),
        ]
        assert all(step.forward for step in path)


def test_annex_C_answers_are_independent_of_the_vehicle(raptor):
    X = raptor.get_transformation("Digiclops:ImagePlane", "FrontNoddingSICK:Origin")
    np.testing.assert_allclose(X.position, (0.299, -0.056, 0.433), atol=1e-12)
    np.testing.assert_allclose(np.degrees(X.rpy), (0.0, -19.25, 0.0), atol=1e-2)


# --- the vehicle --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", ["Left", "Center", "Right"])
def test_the_cabin_front_rail_is_tilted_forward_by_12_degrees(raptor, side):
    R = raptor.get_transformation(f"Raptor:CabFrontRail{side}", "Raptor:Origin").rotation
    # forward: its x axis points down, and what stands upright on it leans ahead
    np.testing.assert_allclose(R @ (1, 0, 0), (np.cos(np.radians(12)), 0, -np.sin(np.radians(12))), atol=1e-12)
    np.testing.assert_allclose(R @ (0, 0, 1), (np.sin(np.radians(12)), 0, np.cos(np.radians(12))), atol=1e-12)
    np.testing.assert_allclose(R @ (0, 1, 0), (0, 1, 0), atol=1e-12)


def test_frames_are_where_their_names_state(raptor):
    def at(frame, reference="Raptor:Origin"):
        return raptor.get_transformation(frame, reference).position

    def corner(name):
        return at(f"Raptor:{name}", "Raptor:CG")

    assert (np.sign(corner("FrontLeftCorner")[:2]) == (1, 1)).all()
    assert (np.sign(corner("FrontRightCorner")[:2]) == (1, -1)).all()
    assert (np.sign(corner("RearLeftCorner")[:2]) == (-1, 1)).all()
    assert (np.sign(corner("RearRightCorner")[:2]) == (-1, -1)).all()
    np.testing.assert_allclose(at("Raptor:FrontLeftCorner") - at("Raptor:RearRightCorner"), (2.5, 1.4, 0.0), atol=1e-12)
    ground = at("Raptor:RearAxleCenter")[2]
    assert at("Raptor:CG")[2] - ground == pytest.approx(1.9 / 3.0, abs=1e-3)
    for end in ("Front", "Rear"):
        left, right = at(f"Raptor:{end}LeftWheelContact"), at(f"Raptor:{end}RightWheelContact")
        np.testing.assert_allclose(left - right, (0.0, 1.15, 0.0), atol=1e-12)
    for rail in ("CabFront", "CabRear", "BoxFront", "BoxRear"):
        left, center, right = (at(f"Raptor:{rail}Rail{side}") for side in ("Left", "Center", "Right"))
        np.testing.assert_allclose((left + right) / 2, center, atol=1e-12)
        assert left[1] > right[1]
    assert (raptor.get_transformation("Microstrain:Sensor", "Raptor:CG").rotation @ (0, 0, 1))[2] == pytest.approx(-1)
    assert raptor.get_transformation("BackNoddingSICK:Origin", "Raptor:CG").rotation[0, 0] == pytest.approx(-1)
    # the two are surveyed alike
    for frame in raptor.get_body_frame_list("FrontNoddingSICK"):
        assert raptor.frame(f"FrontNoddingSICK:{frame}").pose == raptor.frame(f"BackNoddingSICK:{frame}").pose


def test_what_the_report_does_not_give_is_marked(raptor):
    """A pose that is not the identity is the report's, or is marked as estimated."""
    sick = {"AxleCenterFreeEnd", "BottomPlateCorner"}
    given = {"FrontNoddingSICK": sick, "BackNoddingSICK": sick, "Digiclops": {"ImagePlane"}}
    for body in raptor.bodies:
        for frame in body:
            if frame.name not in given.get(body.name, ()) and frame.pose != type(frame.pose).identity():
                assert frame.description.startswith("ESTIMATE: "), f"{body.name}:{frame.name}"
    for constraint in raptor.constraints:
        if constraint.name not in ("FrontNoddingSICKFixed", "DigiclopsFixed"):
            assert constraint.description.startswith("ESTIMATE: "), constraint.name


# --- the files ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file", FILES)
def test_the_file_checks_clean(file):
    model, problems = check_file(RAPTOR / file)
    assert model is not None
    assert problems == ()


def test_both_files_are_equal():
    xml, yaml = (load_model(RAPTOR / file) for file in FILES)
    assert [body.name for body in xml.bodies] == [body.name for body in yaml.bodies]
    for mine, theirs in zip(xml.bodies, yaml.bodies, strict=True):
        assert [frame.name for frame in mine] == [frame.name for frame in theirs]
        for a, b in zip(mine, theirs, strict=True):
            assert a.description == b.description
            np.testing.assert_allclose(a.pose.matrix, b.pose.matrix, rtol=0, atol=1e-12)
    assert len(xml.constraints) == len(yaml.constraints)
    for mine, theirs in zip(xml.constraints, yaml.constraints, strict=True):
        assert (mine.name, mine.from_, mine.to, mine.description) == (
            theirs.name, theirs.from_, theirs.to, theirs.description
        )  # fmt: skip
        # the form of 2005 has no joints: what nods is fixed there where it rests
        assert mine.joint == FIXED
        np.testing.assert_allclose(mine.pose.matrix, theirs.default_pose.matrix, rtol=0, atol=1e-12)
    assert [each.name for each in yaml.constraints if each.joint.is_movable] == [
        "FLEALateral",
        "FrontNoddingSICKAxis",
        "BackNoddingSICKAxis",
    ]


# --- the cameras (report 6.3, 6.4) --------------------------------------------------------------------------


def test_the_digiclops_has_the_four_measurement_points_of_the_report_and_its_lenses_form_an_L(raptor):
    assert raptor.frame("Digiclops:Pivot").pose == Pose.identity()
    R_OI = raptor.frame("Digiclops:ImagePlane").pose.rotation
    right = raptor.frame("Digiclops:RightLens").pose
    assert right == raptor.frame("Digiclops:ImagePlane").pose
    for name, baseline in (("LeftLens", (0.0, 0.1, 0.0)), ("TopLens", (0.0, 0.0, 0.1))):
        lens = raptor.frame(f"Digiclops:{name}").pose
        np.testing.assert_allclose(R_OI.T @ (lens.position - right.position), baseline, atol=1e-5)
        np.testing.assert_allclose(lens.rotation, R_OI, atol=1e-12)


def test_given_a_positive_angle_when_the_flea_is_turned_then_it_looks_left_about_the_normal_of_its_rail():
    raptor = load_model(RAPTOR / "geometry.yaml")
    joint = raptor.joints["FLEALateral"].joint
    assert joint.type is JointType.REVOLUTE
    np.testing.assert_allclose(
        np.degrees((*joint.lower, *joint.upper, *joint.default_position)), (-90, 90, 0), atol=1e-12
    )
    assert joint.sigma is not None
    route = raptor.get_kinematic_path("FLEA:Lens", "Raptor:CabFrontRailRight")
    ahead = route.compute_pose(((0.0,),))
    assert ahead.is_close(raptor.get_transformation("FLEA:Lens", "Raptor:CabFrontRailRight").pose)
    c, s = np.cos(np.radians(30.0)), np.sin(np.radians(30.0))
    turned = route.compute_pose(((np.radians(30.0),),))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(turned.rotation, R @ ahead.rotation, atol=1e-12)
    np.testing.assert_allclose(turned.position, (0.03 + 0.05 * c, 0.05 * s, 0.06), atol=1e-12)
    assert (turned.rotation @ (1.0, 0.0, 0.0))[1] > 0.0


# --- what nods ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", ["Front", "Back"])
def test_given_a_positive_angle_when_a_laser_nods_then_it_looks_up_and_stays_on_its_axle(side):
    raptor = load_model(RAPTOR / "geometry.yaml")
    joint = raptor.joints[f"{side}NoddingSICKAxis"].joint
    assert joint.type is JointType.REVOLUTE
    np.testing.assert_allclose(np.degrees((*joint.lower, *joint.upper, *joint.rate_limit)), (-30, 20, 90), atol=1e-12)
    # the resolution, read as an even spread over one step
    assert np.degrees(joint.sigma[0]) == pytest.approx(0.072 / 12**0.5, abs=5e-4)
    route = raptor.get_kinematic_path(f"{side}SICKLaser:Scan", f"{side}NoddingSICK:Origin")
    nodded = route.compute_pose(((np.radians(10.0),),))
    np.testing.assert_allclose(nodded.position, (0.24, 0.0, 0.18), atol=1e-12)
    np.testing.assert_allclose(
        nodded.rotation @ (1, 0, 0), (np.cos(np.radians(10)), 0, np.sin(np.radians(10))), atol=1e-12
    )
    # the axle is the one that was measured
    free_end = raptor.get_transformation(
        f"{side}NoddingSICK:AxleCenterFreeEnd", f"{side}NoddingSICK:NoddingAxis"
    ).position
    np.testing.assert_allclose(free_end, (0.0, 0.15, 0.0), atol=1e-12)


def test_given_the_vehicle_file_then_its_axis_drives_a_joint_of_the_geometry_within_its_limits():
    raptor = load_model(RAPTOR / "geometry.yaml")
    axis = load_config(RAPTOR / "vehicle.yaml").drivers["front_axis"]
    joint = raptor.joints[axis["joint"]].joint
    for key in ("lower_deg", "upper_deg"):
        assert not joint.is_out_of_limits((np.radians(axis["nod"][key]),))
    assert axis["nod"]["rate_deg"] <= np.degrees(joint.rate_limit[0])


# --- how errors grow (report 4.6.3) -------------------------------------------------------------------------


def surveyed_alike(model: Model, sigma: Sigma) -> Model:
    """Return the model with one sigma at everything that was surveyed; what is so by definition stays exact."""

    def again(part):
        return replace(part, sigma=sigma if part.sigma is not None or part.pose != Pose.identity() else None)

    bodies = tuple(replace(body, frames=tuple(again(frame) for frame in body)) for body in model.bodies)
    return Model(bodies, tuple(again(each) for each in model.constraints))


def test_given_1_mm_and_a_fifth_of_a_degree_at_each_step_then_the_longest_path_is_off_by_centimeters():
    raptor = surveyed_alike(load_model(RAPTOR / "geometry.yaml"), Sigma((0.001,) * 3, (np.radians(0.2),) * 3))
    frames = [f"{body.name}:{frame.name}" for body in raptor.bodies for frame in body]

    def sigma_of(pair):
        return float(np.sqrt(np.trace(raptor.get_transformation(*pair).covariance[:3, :3])))

    count = {pair: len(raptor.get_kinematic_path(*pair).edges) for pair in product(frames, repeat=2)}
    longest = max(count.values())
    most = max((pair for pair in count if count[pair] == longest), key=sigma_of)
    meters = sigma_of(most)
    print(f"A11: {most[0]} in {most[1]}, {longest} edges: 1 sigma of position {meters * 100:.1f} cm")
    # docs/geometry-files.md quotes these
    assert (*most, longest) == ("FrontSICKLaser:Scan", "BackSICKLaser:Scan", 12)
    assert meters == pytest.approx(0.0222, abs=1e-4)
    # without the angles it would be millimeters: it is the arms that make centimeters of it
    lengths_alone = surveyed_alike(raptor, Sigma((0.001,) * 3)).get_transformation(*most).covariance
    assert np.sqrt(np.trace(lengths_alone[:3, :3])) == pytest.approx(0.0047, abs=1e-4)


def test_the_yaml_states_its_sigmas_and_errors_grow_along_the_path():
    """The report's 4.6.3: +-1 mm at each step adds up to more at the end of a path."""
    raptor = load_model(RAPTOR / "geometry.yaml")
    surveyed = raptor.get_transformation("Digiclops:ImagePlane", "FrontNoddingSICK:Origin").covariance
    estimated = raptor.get_transformation("Digiclops:ImagePlane", "Raptor:Origin").covariance
    assert surveyed is not None
    assert estimated is not None
    assert (np.sqrt(np.diag(surveyed)[:3]) > 0.001).all()
    assert (np.sqrt(np.diag(surveyed)[:3]) < 0.01).all()
    assert (np.diag(estimated) > np.diag(surveyed)).all()


def test_the_vehicle_file_names_frames_that_are_there(raptor):
    config = load_config(RAPTOR / "vehicle.yaml")
    assert Path(config.geometry) == RAPTOR / "geometry.yaml"
    assert config.sensors.gps is not None
    assert config.sensors.imu is not None
    assert config.sensors.wheels is not None
    for frame in (
        config.base_frame,
        config.sensors.gps.frame,
        config.sensors.imu.frame,
        *config.sensors.wheels.frames.values(),
    ):
        raptor.frame(frame)
