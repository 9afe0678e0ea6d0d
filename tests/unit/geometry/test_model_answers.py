"""What a model answers, caches and rejects."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from support_geometry import all_frames, chain, random_builder, star

from modelserver.errors import LimitError, NotConnectedError, UnknownBodyError, UnknownFrameError
from modelserver.geometry import Body, BodyFrame, Constraint, Model, ModelBuilder, Search, Sigma, names, topology
from modelserver.geometry import model as model_module
from modelserver.transforms import Pose


def pair(**changes):
    """Return a model of two bodies; `changes` replace parts of it."""
    content = {
        "first": "A",
        "frame": "a",
        "pose": Pose((1, 0, 0)),
        "sigma": Sigma((1e-3, 1e-3, 1e-3)),
        "frame_description": "",
        "body_description": "",
        "constraint": "AB",
        "joint_pose": Pose((0, 1, 0)),
        "joint_sigma": None,
        "inertia": None,
        "body_pose": None,
    } | changes
    builder = ModelBuilder()
    first = builder.add_body(content["first"], content["body_description"], content["body_pose"], content["inertia"])
    first.add_frame(content["frame"], content["pose"], content["frame_description"], content["sigma"])
    builder.add_body("B").add_frame("b")
    builder.add_constraint(
        content["constraint"],
        f"{content['first']}:{content['frame']}",
        "B:b",
        content["joint_pose"],
        sigma=content["joint_sigma"],
    )
    return builder.build()


def test_revision_is_the_same_for_the_same_content():
    assert pair().revision == pair().revision
    assert len(pair().revision) == 16
    # what is equal counts as equal, however it was written
    assert pair(pose=Pose((1.0, -0.0, 0), (-2, 0, 0, 0))).revision == pair().revision
    assert pair(sigma=Sigma(np.full(3, 1e-3), [0, 0, 0])).revision == pair().revision
    rows = tuple(tuple(range(6)) for _ in range(6))
    assert pair(inertia=rows).revision == pair(inertia=np.array(rows)).revision


@pytest.mark.parametrize(
    "change",
    [
        {"first": "A2"},
        {"frame": "a2"},
        {"pose": Pose((1 + 1e-15, 0, 0))},
        {"pose": Pose((1, 0, 0), (1, 1e-9, 0, 0))},
        {"sigma": None},
        {"sigma": Sigma((1e-3, 1e-3, 2e-3))},
        {"frame_description": "left eye"},
        {"body_description": "a camera"},
        {"constraint": "AB2"},
        {"joint_pose": Pose((0, 1, 1e-9))},
        {"joint_sigma": Sigma()},
        {"inertia": tuple(tuple(float(i == j) for i in range(6)) for j in range(6))},
        {"body_pose": Pose()},
    ],
)
def test_revision_changes_with_the_content(change):
    assert pair(**change).revision != pair().revision


def test_revision_depends_on_order_and_sense():
    a, b = Body("A", (BodyFrame("a"),)), Body("B", (BodyFrame("b"),))
    revisions = {
        Model((a, b), (Constraint("AB", "A:a", "B:b"),)).revision,
        Model((b, a), (Constraint("AB", "A:a", "B:b"),)).revision,
        Model((a, b), (Constraint("AB", "B:b", "A:a"),)).revision,
        Model((a, b), ()).revision,
    }
    assert len(revisions) == 4


def test_a_duplicated_body_stands_where_it_is_mounted_not_where_the_first_is():
    # the copies share their frames, which are values
    camera = Body("Left", (BodyFrame("Mount"), BodyFrame("Lens", Pose((0.1, 0, 0)))))
    rail = Body("Rail", (BodyFrame("L", Pose((0, 1, 0))), BodyFrame("R", Pose((0, -1, 0)))))
    model = Model(
        (rail, camera, camera.with_name("Right")),
        (Constraint("l", "Rail:L", "Left:Mount"), Constraint("r", "Rail:R", "Right:Mount")),
    )
    assert model.get_transformation("Left:Lens", "Right:Lens").pose == Pose((0, 2, 0))


def test_unknown_names_are_distinguished_with_the_nearest():
    model = pair()
    with pytest.raises(UnknownBodyError, match="no body 'C'"):
        model.get_transformation("C:a", "A:a")
    with pytest.raises(UnknownFrameError, match="body A has no frame 'b'"):
        model.get_transformation("A:b", "A:a")
    with pytest.raises(UnknownFrameError, match=r"body A has no frame 'Origin'; its frames are A:a"):
        model.get_transformation("A:a", "A")
    with pytest.raises(UnknownFrameError, match=r"'A:a:b' is not of the form Body:Frame"):
        model.get_transformation("A:a", "A:a:b")
    with pytest.raises(UnknownBodyError):
        model.get_body_frame_list("C")
    big = star(20).build()
    with pytest.raises(UnknownFrameError) as caught:
        big.get_transformation("Hub:Mont00003", "Hub:Mount00001")
    assert caught.value.nearest[0] == "Hub:Mount00003"
    with pytest.raises(UnknownBodyError) as caught:
        big.get_transformation("Divice00007:Origin", "Hub:Mount00001")
    assert caught.value.nearest[0] == "Device00007:Origin"
    with pytest.raises(UnknownBodyError) as caught:
        big.find_path("Hub Mount00003", "Hub:Mount00001")
    assert caught.value.nearest[0] == "Hub:Mount00003"


def test_a_failed_query_is_not_cached():
    model = pair()
    for name in ("C:a", "A:b", "A", "", ":", "x" * 60_000):
        with pytest.raises((UnknownBodyError, UnknownFrameError)):
            model.get_transformation(name, "A:a")
    assert len(model._transformations) == 0
    assert set(model._tree.nodes) == set(all_frames(model))


def test_not_connected_names_both_assemblies_shortly():
    builder = chain(40)
    builder.add_body("Alone").add_frame("x")
    with pytest.raises(NotConnectedError) as caught:
        builder.build().get_transformation("Alone:x", "B3:In")
    assert "from B3 to Alone" in str(caught.value)
    assert "[Alone]" in str(caught.value)
    assert len(str(caught.value)) < 200


def test_cache_is_bounded_and_answers_do_not_change_when_the_oldest_go(monkeypatch):
    monkeypatch.setattr(model_module, "CACHE_SIZE", 10)
    import random

    model = random_builder(random.Random(4), 6, sigmas=True).build()
    frames = all_frames(model)
    first = {(a, b): model.get_transformation(a, b) for a in frames for b in frames}
    assert len(model._transformations) == 10
    for (a, b), answer in first.items():
        again = model.get_transformation(a, b)
        assert again == answer
    assert len(model._transformations) == 10
    assert len(model._tree.nodes) == len(frames)
    # the newest are those that stay
    assert list(model._transformations) == list(first)[-10:]
    a, b = frames[0], frames[1]
    assert model.get_transformation(a, b) is model.get_transformation(a, b)


def test_nothing_can_be_set_on_a_model_or_its_parts():
    model = pair()
    for thing, name in (
        (model, "bodies"),
        (model, "revision"),
        (model, "_answers"),
        (model.root, "frames"),
        (model.root.frames[0], "pose"),
        (model.constraints[0], "to"),
        (model.root.frames[0].sigma, "position"),
    ):
        with pytest.raises(AttributeError):
            setattr(thing, name, 1)
        with pytest.raises(AttributeError):
            delattr(thing, name)
    with pytest.raises(AttributeError):
        model.extra = 1


def test_pickles_and_copies_answer_alike_even_after_queries():
    model = pair(joint_sigma=Sigma())
    answer = model.get_transformation("B:b", "A:a")
    for back in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model)):
        assert back.revision == model.revision
        assert back.bodies == model.bodies
        assert back.get_transformation("B:b", "A:a") == answer
    assert repr(model).startswith("<Model unnamed: 2 bodies, 2 frames, 1 constraints, revision ")


def test_parts_compare_and_hash_by_value():
    frame = BodyFrame("a", Pose((1, 2, 3)), "text", Sigma((1, 2, 3)))
    assert frame == BodyFrame("a", Pose((1, 2, 3)), "text", Sigma([1, 2, 3]))
    body = Body("A", (frame,))
    assert len({body, Body("A", (frame,)), body.with_name("B")}) == 2
    assert pickle.loads(pickle.dumps(body)) == body
    assert pickle.loads(pickle.dumps(body)).frame("a") == frame
    assert body.with_name("B").frames == body.frames
    assert list(body.with_frame(BodyFrame("b")).without_frame("a")) == [BodyFrame("b")]
    with pytest.raises(ValueError, match="two frames named a"):
        body.with_frame(BodyFrame("a"))
    with pytest.raises(UnknownFrameError) as caught:
        body.without_frame("A")
    assert caught.value.nearest == ("A:a",)
    constraint = Constraint("c", "A:a", "B:b")
    assert (constraint.other_end("A:a"), constraint.other_end("B:b")) == ("B:b", "A:a")
    with pytest.raises(ValueError, match="does not join C:c"):
        constraint.other_end("C:c")


@pytest.mark.parametrize("wrong", [(1, 1), (1, 1, 1, 1), (-1, 0, 0), (np.nan, 0, 0), (np.inf, 0, 0), (1e200, 0, 0)])
def test_sigmas_are_three_and_three_finite_numbers(wrong):
    with pytest.raises(ValueError, match="sigma"):
        Sigma(position=wrong)
    with pytest.raises(ValueError, match="sigma"):
        Sigma(rotation=wrong)
    with pytest.raises(ValueError, match="sigma"):
        Sigma(wrong[:2], (0, 0, 0, 0))


def test_sigma_of_arrays_is_the_same_as_of_tuples():
    np.testing.assert_array_equal(
        Sigma(np.array([1, 2, 3]), np.array([4, 5, 6])).covariance, np.diag([1.0, 4, 9, 16, 25, 36])
    )


@pytest.mark.parametrize("rows", [((1.0,) * 6,) * 5, ((1.0,) * 5,) * 6, ((np.nan,) * 6,) * 6, ()])
def test_inertia_is_six_by_six(rows):
    with pytest.raises(ValueError, match="6 rows of 6 finite numbers"):
        Body("A", (), inertia=rows)


@pytest.mark.slow
def test_a_chain_of_two_thousand_bodies():
    model = chain(2000).build()
    assert model.problems == ()
    far, near = "B1999:In", "B0:Out"
    assert len(model.find_path(far, near)) == 1999
    assert len(model.find_path(far, near, Search.DEPTH_FIRST)) == 1999
    answer = model.get_transformation(far, near)
    expected = Pose()
    for number in range(1999):
        expected = (
            expected @ Pose((0, 0, 0.01))
            if number == 0
            else (
                expected
                @ Pose.from_rpy((0.1, 0, 0), 0, 0.1, 0).inverse()
                @ Pose.from_rpy((0.2, 0.1, 0), 0, 0, 0.3)
                @ Pose((0, 0, 0.01))
            )
        )
    assert answer.pose.is_close(expected, 1e-9, 1e-9)


@pytest.mark.slow
def test_a_ring_of_two_thousand_bodies_is_one_loop_and_the_message_stays_short():
    builder = chain(2000)
    builder.add_constraint("Last", "B1999:Out", "B0:In")
    model = builder.build()
    (problem,) = model.problems
    assert "(2000 in all)" in problem.message
    assert len(problem.message) < 400
    assert len(model.find_path("B1500:In", "B0:In")) == 500


def test_the_depth_first_search_gives_up_on_dense_loops(monkeypatch):
    monkeypatch.setattr(topology, "DEPTH_FIRST_VISITS", 2000)
    builder = ModelBuilder()
    count = 9
    for i in range(count):
        body = builder.add_body(f"B{i}")
        for j in range(count):
            if i != j:
                body.add_frame(f"to{j}")
        body.add_frame("free")
    builder.add_body("Alone").add_frame("x")
    for i in range(count):
        for j in range(i):
            builder.add_constraint(f"C{i}_{j}", f"B{i}:to{j}", f"B{j}:to{i}")
    model = builder.build()
    with pytest.raises(LimitError, match="use the breadth-first search"):
        model.find_path("Alone:x", "B0:free", Search.DEPTH_FIRST)
    assert len(model.find_path("B8:free", "B0:free")) == 1


@pytest.mark.parametrize("full", ["World:UTM", "World:ENU", "Odom:Origin", "base:Origin", "map:Origin", "Cart:Base"])
def test_short_names_of_frames_are_those_of_ros_and_lead_back_to_the_full_ones(full):
    assert names.complete(names.shorten(full)) == full
    assert (names.shorten("World:ENU"), names.shorten("base_link:Origin")) == ("map", "base_link")
