"""Rules between joints: coordinate names, mimic chains, and default positions."""

from __future__ import annotations

import math
import random

import pytest

from modelserver.errors import GeometryError, Location, Severity
from modelserver.geometry import Joint, JointType, Mimic, ModelBuilder
from modelserver.geometry.parts import JointDrive
from modelserver.transforms import Pose

X = (1.0, 0.0, 0.0)


def slide(mimic=None, **stated):
    return Joint(JointType.PRISMATIC, X, mimic=mimic, **stated)


def comb(**joints):
    """Return a builder of a body for each joint, named as it is in small, all on the first body."""
    builder = ModelBuilder("comb")
    builder.add_body("Base").add_frame("O")
    for number, (name, joint) in enumerate(joints.items(), 10):
        name = name.replace("__", ".")
        body = name.lower().replace(".", "_")
        builder.add_body(body, source=Location("comb", number)).add_frame("o")
        builder.add_constraint(name, "Base:O", f"{body}:o", joint=joint, source=Location("comb", number))
    return builder


def errors(builder):
    with pytest.raises(GeometryError) as caught:
        builder.build()
    return [each for each in caught.value.problems if each.severity is Severity.ERROR]


def only(builder):
    (problem,) = errors(builder)
    assert problem.fix
    return problem


def place(model, body):
    return model.get_transformation(f"{body}:o", "Base:O").position[0]


def test_given_joints_that_follow_over_two_steps_then_each_drive_is_that_of_the_whole_way():
    model = comb(C=slide(Mimic("B", 2.0, 0.1)), A=slide(default=(0.5,)), B=slide(Mimic("A", -3.0, 0.25))).build()
    assert model.problems == ()
    assert model.drives == {
        "C": JointDrive(("A",), "A", -6.0, 0.6),
        "A": JointDrive(("A",), "A"),
        "B": JointDrive(("A",), "A", -3.0, 0.25),
    }


def test_given_a_joint_that_follows_then_it_rests_where_its_leaders_rest_takes_it():
    model = comb(A=slide(default=(0.5,)), B=slide(Mimic("A", -3.0, 0.25)), C=slide(Mimic("B", 2.0, 0.1))).build()
    assert [place(model, each) for each in "abc"] == pytest.approx([0.5, -1.25, -2.4])
    # and building again of what was built changes nothing
    again = ModelBuilder("comb")
    for body in model.bodies:
        again.copy_body(body)
    for each in model.constraints:
        again.add_constraint(each.name, each.from_, each.to, each.pose, each.description, each.sigma, each.joint)
    assert again.build().problems == ()
    assert again.build().revision == model.revision


def test_given_a_planar_joint_then_no_other_may_be_called_as_one_of_its_coordinates():
    problem = only(comb(A=Joint(JointType.PLANAR), A__x=slide()))
    assert problem.message == (
        "constraint 'A.x': a coordinate of its joint is called 'A.x', as is one of constraint A (first at comb:10)"
    )
    assert problem.line == 11
    assert "rename" in problem.fix
    # one that does not move has no coordinate to be mistaken
    assert comb(A=Joint(JointType.PLANAR), A__x=Joint()).build().problems == ()
    repaired = comb(A=Joint(JointType.PLANAR), A__x=slide()).build(repair=True)
    assert list(repaired.joints) == ["A"]


@pytest.mark.parametrize(
    ("joints", "message", "fix"),
    [
        ({"A": slide(Mimic("A"))}, "constraint 'A': its joint follows itself", "remove mimic"),
        (
            {"Pan": slide(), "B": slide(Mimic("Pam"))},
            "follows 'Pam', and there is no constraint of that name",
            "write Pan",
        ),
        ({"B": slide(Mimic("Nobody"))}, "follows 'Nobody', and there is no constraint", "joints here are: B"),
        ({"A": Joint(), "B": slide(Mimic("A"))}, "follows A, which does not move", "remove mimic"),
        (
            {"A": Joint(JointType.PLANAR), "B": slide(Mimic("A"))},
            "follows A, a planar one with 3 coordinates",
            "revolute or prismatic",
        ),
        (
            {"A": slide(Mimic("B")), "B": slide(Mimic("C")), "C": slide(Mimic("A"))},
            "joints follow each other in a cycle: A follows B follows C follows A",
            "remove the mimic of one",
        ),
        # a follower of a joint of the cycle is not reported
        (
            {"T": slide(Mimic("A")), "A": slide(Mimic("B")), "B": slide(Mimic("A"))},
            "in a cycle: A follows B follows A",
            "remove",
        ),
        ({"A": slide(default=(3.0,)), "B": slide(Mimic("A", 1e9))}, "beyond 1e+09", "multipliers"),
        # what follows one out of range is back in range, and has lost its leader
        (
            {"A": slide(default=(3.0,)), "B": slide(Mimic("A", 1e9)), "C": slide(Mimic("B", 1e-9))},
            "constraint 'B': following A puts its joint beyond 1e+09",
            "multipliers",
        ),
        (
            {"A": slide(default=(3.0,)), "B": slide(Mimic("A", 1e200)), "C": slide(Mimic("B", 1e200))},
            "constraint 'B': following A puts its joint beyond 1e+09",
            "multipliers",
        ),
    ],
)
def test_given_a_joint_that_cannot_follow_then_it_is_named_with_the_remedy_and_repair_drops_it(joints, message, fix):
    problem = errors(comb(**joints))[0]
    assert message in problem.message
    assert fix in problem.fix
    assert problem.line >= 10
    model = comb(**joints).build(repair=True)
    assert all(each.severity is Severity.WARNING for each in model.problems)
    assert all(each.joint.mimic is None for each in model.constraints)


def test_given_several_faults_then_each_is_reported_once():
    joints = {"A": slide(Mimic("B")), "B": slide(Mimic("A")), "C": slide(Mimic("C")), "D": slide(Mimic("E"))}
    assert [each.line for each in errors(comb(**joints))] == [10, 12, 13]


def test_given_a_leader_that_is_broken_itself_then_its_followers_are_no_second_fault():
    builder = comb(B=slide(Mimic("A")), C=slide(Mimic("B")))
    builder.add_constraint("A", "Base:Nope", "b:o", joint=slide(), source=Location("comb", 9))
    assert "Nope" in only(builder).message
    model = builder.build(repair=True)
    assert model.get_body_list() == ["Base"]
    assert "its joint follows A, which was removed; removed" in " | ".join(each.message for each in model.problems)


@pytest.mark.parametrize("seed", range(30))
def test_given_joints_that_follow_at_random_then_a_model_or_the_faults_come_of_it(seed):
    rng = random.Random(seed)
    names = [f"J{n}" for n in range(8)]
    joints = {name: slide(Mimic(rng.choice(names))) if rng.random() < 0.7 else slide() for name in names}
    model, problems = comb(**joints).check()
    assert (model is None) == bool(problems)
    repaired = comb(**joints).build(repair=True)
    for name, drive in repaired.drives.items():
        assert repaired.joints[drive.leader].joint.mimic is None
        follows = repaired.joints[name].joint.mimic
        assert follows is None or repaired.drives[follows.joint].leader == drive.leader


@pytest.mark.slow
def test_given_thousands_that_follow_each_other_then_the_last_follows_the_first():
    joints = {f"J{n}": slide(Mimic(f"J{n + 1}")) for n in range(2_999)} | {"J2999": slide(default=(0.5,))}
    model = comb(**joints).build()
    assert model.drives["J0"].leader == "J2999"
    assert place(model, "j0") == 0.5


@pytest.mark.slow
@pytest.mark.parametrize("last", [slide(Mimic("Nobody")), slide(Mimic("J2999")), slide(Mimic("J2998")), Joint()])
@pytest.mark.parametrize("backwards", [False, True])
def test_given_thousands_that_follow_one_that_cannot_then_it_alone_is_reported(last, backwards):
    joints = {f"J{n}": slide(Mimic(f"J{n + 1}")) for n in range(2_999)} | {"J2999": last}
    if backwards:
        joints = dict(reversed(joints.items()))
    assert len(errors(comb(**joints))) == 1
    model = comb(**joints).build(repair=True)
    assert not model.joints
    assert all(each.severity is Severity.WARNING for each in model.problems)


def test_given_a_leaders_rest_out_of_a_followers_limits_then_that_is_a_warning():
    model = comb(A=slide(default=(0.5,)), B=Joint(JointType.REVOLUTE, X, upper=(0.2,), mimic=Mimic("A", 2.0))).build()
    (problem,) = model.problems
    assert problem.severity is Severity.WARNING
    assert problem.message == "constraint 'B': at the default of A, its joint is at 57.3 deg, out of its limits"
    assert problem.line == 11


def test_given_a_default_of_a_joint_that_follows_then_that_is_a_warning_and_it_counts_for_nothing():
    model = comb(A=slide(default=(0.5,)), B=slide(Mimic("A"), default=(0.1,))).build()
    (problem,) = model.problems
    assert "the default of its joint is not used, because it follows A" in problem.message
    assert place(model, "b") == 0.5


def test_given_a_sigma_of_a_joint_that_follows_then_that_is_a_warning():
    model = comb(A=slide(sigma=(0.001,)), B=slide(Mimic("A"), sigma=(0.002,))).build()
    (problem,) = model.problems
    assert "the sigma of its joint is not used, because it follows A" in problem.message


@pytest.mark.parametrize("stated", [{"lower": (-30.0,)}, {"upper": (45.0,)}, {"default": (20.0,)}])
def test_given_an_angle_beyond_two_turns_then_degrees_are_suspected(stated):
    (problem,) = comb(A=Joint(JointType.REVOLUTE, X, **stated)).build().problems
    assert problem.severity is Severity.WARNING
    assert "turns" in problem.message
    assert "limits_deg" in (problem.fix or "")


@pytest.mark.parametrize("stated", [{"lower": (-6.3,), "upper": (6.3,)}, {"rate_limit": (30.0,)}])
def test_given_angles_up_to_two_turns_then_there_is_no_warning(stated):
    assert not comb(A=Joint(JointType.REVOLUTE, X, **stated)).build().problems
    assert not comb(A=slide(lower=(-30.0,), upper=(30.0,))).build().problems


def test_given_joints_then_the_revision_changes_with_each_of_their_numbers():
    def revision(**changes):
        stated = {"lower": (-1.0,), "upper": (1.0,), "rate_limit": (2.0,), "default": (0.5,), "sigma": (0.1,)} | changes
        return comb(A=Joint(JointType.PRISMATIC, **({"axis": X} | stated)), B=slide()).build().revision

    changes = [
        {"lower": ()},
        {"upper": (0.9,)},
        {"rate_limit": ()},
        {"default": ()},
        {"sigma": ()},
        {"axis": (0, 1, 0)},
    ]
    assert len({revision(), *(revision(**change) for change in changes)}) == len(changes) + 1


def test_given_a_turn_at_rest_then_answers_of_the_model_have_it():
    model = comb(A=Joint(JointType.REVOLUTE, (0, 0, 1), default=(math.pi / 2,))).build()
    assert model.get_transformation("a:o", "Base:O").pose.is_close(Pose.from_rpy((0, 0, 0), yaw=math.pi / 2), 0, 1e-15)
