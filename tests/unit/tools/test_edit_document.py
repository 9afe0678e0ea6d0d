"""A geometry file is edited in its text: what is not changed stays byte for byte, and the model is what was meant."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from modelserver.formats import parse_content, parse_model
from modelserver.geometry import Joint, JointType, Mimic, Model
from modelserver.geometry.model import describe_changes
from modelserver.transforms import Pose
from mstools.edit import EditError, GeometryDocument, GeometryItem, ItemKind, YamlText

CONFIG = Path(__file__).resolve().parents[3] / "config"
RAPTOR = (CONFIG / "raptor" / "geometry.yaml").read_text()
HUSKY = (CONFIG / "husky" / "geometry.yaml").read_text()

ODD = """\
# head
modelserver:   geometry/1
name: 'odd'   # quoted
templates:
    Wheel:
        frames: {Hub: {xyz: [0, 0.10, 0]}, Rim: {}}
bodies:
    on:
        frames:
            Origin:
            12: {xyz: [ 0.10,  2, 3e-3 ]}   # trailing
            "null": {}

            # the long one, été 🚜
            Long: {xyz: [0.1, 0.2, 0.3], rpy_deg: [0.000, 10, 1], description: "a, b: c"}
    Rover:
        template: Wheel
        frames:
          A:
              xyz:
              - 1.0
              - 2
              - 0.5
              description: >
                folded text
                # no comment

              # comment inside
          # comment of B
          B: {rotation: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}   # turned
    last:
        frames:
            Origin: {}

# all of them
constraints:
  join: {from: on:12, to: Rover:A, joint: {type: revolute, axis: [0,0,1], limits_deg: [-.inf, 20]}}
  # follows
  second:
    from: "Rover : B"
    to: last:Origin
    joint:
      type: prismatic  # slides
      axis: [1, 0, 0]
      mimic: {joint: join, multiplier: 0.5}
"""


JOINT = "joint: {type: revolute, axis: [0,0,1], limits_deg: [-.inf, 20]}"


def frame(name: str) -> GeometryItem:
    return GeometryItem(ItemKind.FRAME, name)


def constraint(name: str) -> GeometryItem:
    return GeometryItem(ItemKind.CONSTRAINT, name)


def load(document: GeometryDocument) -> Model:
    return parse_model(document.text.encode())


def list_changed_lines(old: GeometryDocument, new: GeometryDocument) -> list[str]:
    """Return the lines that were removed and added."""
    lines = difflib.ndiff(old.text.split("\n"), new.text.split("\n"))
    return [line for line in lines if line[:2] in ("- ", "+ ")]


FILES = {"raptor": RAPTOR, "husky": HUSKY, "odd": ODD, "odd, CRLF": ODD.replace("\n", "\r\n")}


def test_given_an_odd_file_then_it_is_one_that_loads() -> None:
    assert not [each for each in parse_content(ODD.encode()).check()[1] if each.severity == "error"]


@pytest.mark.parametrize(
    ("change", "lines"),
    [
        (
            lambda d: d.set_pose(frame("on:12"), (0.1, 2.5, 0.003), (0.0, 0.0, 0.0)),
            [
                "-             12: {xyz: [ 0.10,  2, 3e-3 ]}   # trailing",
                "+             12: {xyz: [0.10, 2.5, 3e-3]}   # trailing",
            ],
        ),
        (
            lambda d: d.set_pose(frame("on:Origin"), (0.0, 0.0, 1.0), (0.0, 0.0, 90.0)),
            ["-             Origin:", "+             Origin: {xyz: [0, 0, 1], rpy_deg: [0, 0, 90]}"],
        ),
        (
            lambda d: d.set_pose(frame("Rover:B"), (0.0, 0.0, 0.0), (0.0, 0.0, 80.0)),
            [
                "-           B: {rotation: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}   # turned",
                "+           B: {rpy_deg: [0, 0, 80]}   # turned",
            ],
        ),
        (
            lambda d: d.set_pose(frame("Rover:B"), (0.0, 0.0, 1.0), (0.0, 0.0, 90.0)),
            [
                "-           B: {rotation: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}   # turned",
                "+           B: {xyz: [0, 0, 1], rotation: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}   # turned",
            ],
        ),
        (
            lambda d: d.set_pose(frame("Rover:Hub"), (0.0, 0.2, 0.0), (0.0, 0.0, 0.0)),
            ["+ ", "+           Hub: {xyz: [0, 0.2, 0]}"],
        ),
        (
            lambda d: d.set_pose(frame("Rover:Hub"), (0.0, 0.2, 0.0), (0.0, 0.0, 0.0), in_template=True),
            [
                "-         frames: {Hub: {xyz: [0, 0.10, 0]}, Rim: {}}",
                "+         frames: {Hub: {xyz: [0, 0.2, 0]}, Rim: {}}",
            ],
        ),
        (
            lambda d: d.set_sigma(constraint("join"), (0.01, 0.01, 0.01), (0.0, 1.0, 2.0)),
            [
                f"-   join: {{from: on:12, to: Rover:A, {JOINT}}}",
                f"+   join: {{from: on:12, to: Rover:A, sigma: {{xyz: 0.01, rpy_deg: [0, 1, 2]}}, {JOINT}}}",
            ],
        ),
        (
            lambda d: d.delete(frame("Rover:B")),
            [
                "-           # comment of B",
                "-           B: {rotation: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}   # turned",
                "-   # follows",
                "-   second:",
                '-     from: "Rover : B"',
                "-     to: last:Origin",
                "-     joint:",
                "-       type: prismatic  # slides",
                "-       axis: [1, 0, 0]",
                "-       mimic: {joint: join, multiplier: 0.5}",
            ],
        ),
        (
            lambda d: d.rename(constraint("join"), "pan"),
            [
                f"-   join: {{from: on:12, to: Rover:A, {JOINT}}}",
                f"+   pan: {{from: on:12, to: Rover:A, {JOINT}}}",
                "-       mimic: {joint: join, multiplier: 0.5}",
                "+       mimic: {joint: pan, multiplier: 0.5}",
            ],
        ),
        (
            lambda d: d.set_joint(
                "second",
                Joint(JointType.PRISMATIC, (1.0, 0.0, 0.0), mimic=Mimic("join", 0.5)),
                Joint(JointType.PRISMATIC, (1.0, 0.0, 0.0), lower=(-1.0,), upper=(1.0,), mimic=Mimic("join", 0.25)),
            ),
            [
                "-       mimic: {joint: join, multiplier: 0.5}",
                "+       mimic: {joint: join, multiplier: 0.25}",
                "+       limits: [-1, 1]",
            ],
        ),
        (
            lambda d: d.duplicate(frame("Rover:A"), "A2"),
            [
                "+ ",
                "+           A2:",
                "+               xyz:",
                "+               - 1.0",
                "+               - 2",
                "+               - 0.5",
                "+               description: >",
                "+                 folded text",
                "+                 # no comment",
            ],
        ),
        (lambda d: d.add_frame("on", "New", (0.0, 0.0, 1.5)), ["+             New: {xyz: [0, 0, 1.5]}"]),
        (
            lambda d: d.set_description(frame("on:12"), 'it: "is" [here]'),
            [
                "-             12: {xyz: [ 0.10,  2, 3e-3 ]}   # trailing",
                '+             12: {xyz: [ 0.10,  2, 3e-3 ], description: "it: \\"is\\" [here]"}   # trailing',
            ],
        ),
        (
            lambda d: d.set_ends("join", "on:Long", "Rover:A"),
            [
                f"-   join: {{from: on:12, to: Rover:A, {JOINT}}}",
                f"+   join: {{from: on:Long, to: Rover:A, {JOINT}}}",
            ],
        ),
    ],
)  # fmt: skip
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_given_a_change_then_only_its_lines_differ(
    change: Callable[[GeometryDocument], GeometryDocument], lines: list[str], newline: str
) -> None:
    old = GeometryDocument(ODD.replace("\n", newline))
    new = change(old)
    assert sorted(line.rstrip("\r") for line in list_changed_lines(old, new)) == sorted(lines)
    assert new.text.count("\r\n") == (new.text.count("\n") if newline == "\r\n" else 0)
    load(new)


def test_given_a_body_renamed_then_its_constraints_follow() -> None:
    old = GeometryDocument(RAPTOR)
    new = load(old.rename(GeometryItem(ItemKind.BODY, "FrontNoddingSICK"), "Front"))
    before = load(old)
    assert [each.name for each in new.bodies][1] == "Front"
    for pair in (("FrontSICKLaser:Scan", "Raptor:Origin"), ("Digiclops:LeftLens", "Raptor:Origin")):
        assert new.get_transformation(*pair).pose == before.get_transformation(*pair).pose


def test_given_a_template_then_all_its_bodies_change_or_only_one() -> None:
    old = GeometryDocument(RAPTOR)
    item = frame("BackNoddingSICK:BottomPlateCorner")
    assert old.find_template(item) == "NoddingSICK"
    assert old.list_users("NoddingSICK") == ["FrontNoddingSICK", "BackNoddingSICK"]
    one = old.set_pose(item, (0.0, 0.0, 0.5), (0.0, 0.0, 0.0))
    assert (
        describe_changes(load(old), load(one)) == ("frame BackNoddingSICK:BottomPlateCorner moved by 0.5348 m",)
        or len(describe_changes(load(old), load(one))) == 1
    )
    both = old.set_pose(item, (0.0, 0.0, 0.5), (0.0, 0.0, 0.0), in_template=True)
    assert len(describe_changes(load(old), load(both))) == 2
    # once it has an entry of its own, the body no longer follows
    assert one.find_template(item) == ""
    renamed = old.rename(item, "Corner", in_template=True)
    assert renamed.find_template(frame("FrontNoddingSICK:Corner")) == "NoddingSICK"
    pose = load(renamed).get_transformation("Digiclops:LeftLens", "Raptor:Origin").pose
    assert pose == load(old).get_transformation("Digiclops:LeftLens", "Raptor:Origin").pose
    for change in (old.rename, lambda item, name: old.delete(item)):
        with pytest.raises(EditError, match="template NoddingSICK"):
            change(item, "Corner")


def test_given_a_line_then_what_stands_on_it_is_found() -> None:
    document = GeometryDocument(RAPTOR)
    lines = RAPTOR.split("\n")
    for text, item in (
        ("  FLEALateral:", constraint("FLEALateral")),
        ("    joint: {type: revolute, axis: [0, 0, 1], limits_deg: [-90, 90]", constraint("FLEALateral")),
        ("      PhaseCenter:", frame("GPSAntenna:PhaseCenter")),
        ("      BottomPlateCorner:", frame("FrontNoddingSICK:BottomPlateCorner")),
        ("  Digiclops:", GeometryItem(ItemKind.BODY, "Digiclops")),
    ):
        line = next(n for n, each in enumerate(lines, 1) if each.startswith(text))
        assert document.find_item(line) == item
    assert document.find_item(1) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.add_body("Rover"), "already"),
        (lambda d: d.add_body("World"), "reserved"),
        (lambda d: d.add_frame("Rover", "a b"), "white space"),
        (lambda d: d.add_frame("Rover", "Hub"), "already"),
        (lambda d: d.add_frame("Nobody", "Hub"), "no body 'Nobody'"),
        (lambda d: d.rename(frame("on:12"), "Long"), "already"),
        (lambda d: d.rename(frame("on:12"), ""), "empty"),
        (lambda d: d.delete(frame("on:13")), "no frame 'on:13'"),
        (lambda d: d.set_yaml(frame("on:12"), "13: {}"), "begins with 12:"),
        (lambda d: d.set_yaml(frame("on:12"), "12: {"), "line"),
        (lambda d: d.set_yaml(frame("on:12"), "[" * 100_000), "nests deeper"),
        (lambda d: d.set_yaml(frame("on:12"), "12: {description: \ud800}"), "no character"),
        (lambda d: d.set_pose(frame("on:12"), (math.nan, 0.0, 0.0), (0.0, 0.0, 0.0)), "nan is no number"),
        (lambda d: d.set_pose(frame("on:12"), (0.0, 0.0, 0.0), (0.0, -math.inf, 0.0)), "-inf is no number"),
        (lambda d: d.set_sigma(frame("on:12"), (0.0, math.inf, 0.0), None), "inf is no number"),
    ],
)  # fmt: skip
def test_given_a_change_that_cannot_be_made_then_the_reason_is_given(
    change: Callable[[GeometryDocument], GeometryDocument], words: str
) -> None:
    with pytest.raises(EditError, match=words):
        change(GeometryDocument(ODD))


def test_given_an_alias_then_what_it_shares_is_not_changed_behind_its_back() -> None:
    text = (
        "bodies:\n  A: &a {frames: {Origin: {}, P: {xyz: &p [1, 2, 3]}}}\n  B: *a\n  C:\n    frames: {Q: {xyz: *p}}\n"
    )
    document = GeometryDocument(text)
    for item in (frame("A:P"), frame("B:P"), frame("C:Q")):
        with pytest.raises(EditError, match="shared by an alias"):
            document.set_pose(item, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert load(document.add_body("D")).get_body_list() == ["A", "B", "C", "D"]


def test_given_the_entry_of_an_item_then_it_is_written_as_given() -> None:
    document = GeometryDocument(ODD)
    for text in (ODD, FILES["odd, CRLF"]):
        same = GeometryDocument(text)
        for item in same.list_items():
            assert same.set_yaml(item, same.get_yaml(item)).text == text
    changed = document.set_yaml(
        GeometryItem(ItemKind.BODY, "last"),
        "last:\n  # with a box\n  visuals: [{box: [1, 2, 3]}]\n  frames: {Origin: {}}\n",
    )
    assert "    last:\n      # with a box\n" in changed.text
    assert load(changed).body("last").visuals[0].size == (1.0, 2.0, 3.0)


def test_given_nothing_yet_then_bodies_and_constraints_are_added() -> None:
    document = GeometryDocument("modelserver: geometry/1\nbodies:\n  A: {frames: {Origin: {}}}\n")
    document = document.add_body("B").add_constraint("AB", "A:Origin", "B:Origin").add_frame("A", "P", (1.0, 0.0, 0.0))
    model = load(document.set_pose(constraint("AB"), (0.0, 0.0, 0.25), (0.0, 0.0, -90.0)))
    assert model.get_transformation("B:Origin", "A:P").pose.is_close(
        Pose.from_rpy((-1.0, 0.0, 0.25), 0, 0, -math.pi / 2)
    )


def test_given_yaml_text_then_an_empty_mapping_stays_one() -> None:
    text = YamlText("a:\n  b: 1\nc: {d: 2}\n").remove(("a", "b")).remove(("c", "d"))
    assert text.text == "a: {}\nc: {}\n"
    assert text.add(("a",), "x: 1", in_block=True).add(("c",), "y: 2").text == "a:\n  x: 1\nc: {y: 2}\n"


numbers = st.floats(-5.0, 5.0).map(lambda value: round(value, 4))
vectors = st.tuples(numbers, numbers, numbers)
angles = st.tuples(st.floats(-179.0, 179.0), st.floats(-89.0, 89.0), st.floats(-179.0, 179.0))
sigmas = st.none() | st.tuples(*[st.floats(0.0, 1.0).map(lambda value: round(value, 4))] * 3)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.data(), st.sampled_from(sorted(FILES)))
def test_given_any_changes_then_the_model_is_what_they_state(data: st.DataObject, file: str) -> None:
    document = GeometryDocument(FILES[file])
    for _ in range(data.draw(st.integers(1, 6))):
        item = data.draw(st.sampled_from(document.list_items()))
        before, old = document, load(document)
        in_template = bool(document.find_template(item)) and data.draw(st.booleans())
        kind = data.draw(st.sampled_from(["pose", "sigma", "text", "rename", "duplicate", "yaml"]))
        changes = []
        if kind == "pose" and item.kind is not ItemKind.BODY:
            xyz, rpy = data.draw(vectors), data.draw(angles)
            document = document.set_pose(item, xyz, rpy, in_template)
            model = load(document)
            found = _find(model, item)
            assert found.pose.is_close(Pose.from_rpy(xyz, *map(math.radians, rpy)), 1e-8, 1e-8)
            changes = [each for each in describe_changes(old, model) if "sigma" not in each]
            assert len(changes) <= (len(before.list_users(before.find_template(item))) if in_template else 1)
        elif kind == "sigma" and item.kind is not ItemKind.BODY:
            position, rotation = data.draw(sigmas), data.draw(sigmas)
            document = document.set_sigma(item, position, rotation, in_template)
            sigma = _find(load(document), item).sigma
            if position is not None:
                assert sigma.position == pytest.approx(position)
            if rotation is not None:
                assert sigma.rotation == pytest.approx([math.radians(each) for each in rotation])
        elif kind == "text":
            text = data.draw(st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=40)).strip()
            if item.kind is not ItemKind.BODY or not before.find_template(item):
                document = document.set_description(item, text, in_template)
                found = load(document).body(item.name) if item.kind is ItemKind.BODY else _find(load(document), item)
                if text:
                    assert found.description == text
        elif kind == "rename" and (in_template or not document.find_template(item)):
            document = document.rename(item, "Renamed#1" if item.kind is ItemKind.BODY else "on", in_template)
            model = load(document)
            assert len(model.bodies) == len(old.bodies)
            assert len(model.constraints) == len(old.constraints)
            # back again: the text is as before, but for the notation of names
            back = "Renamed#1" if item.kind is ItemKind.BODY else "on"
            new = item._replace(name=f"{item.name.partition(':')[0]}:{back}" if ":" in item.name else back)
            again = document.rename(new, item.name.rpartition(":")[2], in_template)
            assert describe_changes(old, load(again)) == ()
            document = again
        elif kind == "duplicate" and item.kind is not ItemKind.CONSTRAINT:
            document = document.duplicate(item, "Copy-1")
            copy = item._replace(name=f"{item.name.partition(':')[0]}:Copy-1" if ":" in item.name else "Copy-1")
            document = document.delete(copy)
            assert describe_changes(old, load(document)) == ()
        elif kind == "yaml":
            assert document.set_yaml(item, document.get_yaml(item)).text == document.text


def _find(model: Model, item: GeometryItem) -> object:
    if item.kind is ItemKind.FRAME:
        return model.frame(item.name)
    return next(each for each in model.constraints if each.name == item.name)
