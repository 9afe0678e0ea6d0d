"""`modelserver query --explain` and `--motion`: text and JSON beyond the pose."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support_moving import BASE, DEEP, SCAN, T0, UTM, S, view

from modelserver.joints import JointHistory
from modelserver.messages import (
    EdgeReport,
    Explanation,
    Invalid,
    MotionAnswer,
    Policy,
    PoseAnswer,
    TimeQuery,
)
from modelserver.query.path import compute_motion, explain
from modelserver.transforms import Pose, Transformation, so3
from mstools.cli import main
from mstools.commands.query import (
    describe,
    describe_edges,
    describe_motion,
    edges_as_data,
    format_coordinates,
    motion_as_data,
)

Run = Callable[..., tuple[int, str, str]]
DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "moving-geometry.md"
AT = TimeQuery(T0 + 2 * S + 5000, Policy.INTERPOLATED)
NOW = T0 + 4 * S

NODDING = """\
modelserver: geometry/1
name: cart
defaults:
  sigma: {xyz: 0.002, rpy_deg: 0.2}
bodies:
  Cart: {frames: {Base: {}, Mast: {xyz: [0.5, 0, 1]}}}
  Laser: {frames: {Axle: {}, Scan: {xyz: [0, 0, 0.1]}}}
constraints:
  Nod: {from: Cart:Mast, to: Laser:Axle, joint: {type: revolute, axis: [0, 1, 0], default_deg: 10, sigma_deg: 0.1}}
"""


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """A function that runs `query` on the nodding cart."""
    path = tmp_path / "cart.yaml"
    path.write_text(NODDING)

    def query(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main(["query", *(str(each) for each in arguments), "--model", str(path)])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(end.value.code or 0), out, err

    return query


# --- explanation


def test_given_a_file_then_each_edge_has_its_row_and_shares_come_to_100_percent(run: Run) -> None:
    code, out, err = run("Laser:Scan", "Cart:Base", "--explain")
    assert (code, err) == (0, "")
    table, _, answer = out.partition("\n\n")
    rows = [line.split() for line in table.splitlines()]
    assert rows[0] == ["Laser:Scan", "in", "Cart:Base", "rests", "on"]
    assert [row[0] for row in rows[2:6]] == ["frame", "constraint", "joint", "frame"]
    assert rows[4][:6] == ["joint", "Nod", "Cart:Mast", "→", "Laser:Axle", "default"]
    assert rows[4][-6:-4] == ["10.000", "deg"]
    assert rows[6] == ["sum", "100.0", "%", "100.0", "%"]
    assert answer.rstrip() == run("Laser:Scan", "Cart:Base")[1].rstrip()
    assert answer.rstrip().endswith(
        "JOINT_DEFAULT: no sample of a joint on the path was received; its position is assumed"
    )


def test_the_table_in_the_documentation_is_what_its_command_prints(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    path = tmp_path / "cart.yaml"
    path.write_text(text.split("```yaml\n")[1].split("```")[0])
    command, _, table = text.split("```console\n$ modelserver ")[1].split("```")[0].partition("\n")
    with pytest.raises(SystemExit):
        main(command.replace("cart.yaml", str(path)).split())
    assert capsys.readouterr().out.rstrip() == table.rstrip()


def test_given_the_way_back_then_edges_are_passed_the_other_way_and_report_it(run: Run) -> None:
    _, out, _ = run("Cart:Base", "Laser:Scan", "--explain")
    assert "Laser:Axle → Cart:Mast, inverse" in out
    assert out.index("Laser:Scan → Laser, inverse") < out.index("Laser:Axle → Cart:Mast, inverse")


def test_given_json_then_it_holds_the_answer_and_the_same_edges(run: Run) -> None:
    plain = json.loads(run("Laser:Scan", "Cart:Base", "--json")[1])
    code, out, _ = run("Laser:Scan", "Cart:Base", "--explain", "--json")
    found: dict[str, Any] = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert code == 0
    edges = found.pop("edges")
    assert found == plain
    assert plain["flags"] == ["JOINT_DEFAULT"]
    joint = edges[2]
    assert (joint["kind"], joint["name"], joint["from"], joint["to"]) == ("joint", "Nod", "Cart:Mast", "Laser:Axle")
    assert (joint["forward"], joint["provenance"], joint["age"], joint["source"]) == (True, "default", None, None)
    assert joint["coordinates"] == [pytest.approx(math.radians(10))]
    assert sum(edge["position_share"] for edge in edges) == pytest.approx(1.0)
    assert sum(edge["rotation_share"] for edge in edges) == pytest.approx(1.0)


def test_given_one_frame_twice_then_the_answer_rests_on_nothing(run: Run) -> None:
    code, out, _ = run("Laser:Axle", "Laser:Axle", "--explain")
    assert code == 0
    assert "rests on nothing" in out


@pytest.mark.parametrize(
    ("arguments", "code", "output"),
    [
        (("Laser:Scan", "Cart:Base", "--motion"), 1, "query the daemon"),
        (("Laser:Scan", "World:UTM", "--explain"), 1, "query the daemon"),
        (("Laser:Scna", "Cart:Base", "--explain"), 1, "Laser:Scan"),
        (("Laser:Scan", "Cart:Base", "--expressed-in", "Cart:Mast"), 2, "--motion"),
        (("Laser:Scan", "Cart:Base", "--explain", "--motion"), 2, "exclude each other"),
    ],
)
def test_given_what_cannot_be_reported_then_it_reports_what_to_do(
    run: Run, arguments: tuple[str, ...], code: int, output: str
) -> None:
    found, out, err = run(*arguments)
    assert (found, out) == (code, "")
    assert output in err


def test_given_a_vehicle_and_joints_that_were_received_then_how_age_and_source_are_reported() -> None:
    text = describe_edges(explain(view(), SCAN, UTM, AT, NOW))
    rows = {line.split()[0]: line for line in text.splitlines() if not line.startswith("  no")}
    assert "World:UTM → Rover:Base" in rows["vehicle"]
    assert "localization" in rows["vehicle"]
    for part in ("interpolated", "1.980 s", "arm", " deg "):
        assert part in rows["joint"]


def test_given_edges_without_sigmas_then_they_have_no_share_and_the_foot_reports_why() -> None:
    text = describe_edges(explain(view(sigma=None), SCAN, BASE, AT, NOW))
    assert "no sigma is known" in text
    assert "100.0 %" in next(line for line in text.splitlines() if line.lstrip().startswith("joint"))
    data = json.loads(json.dumps(edges_as_data(explain(view(sigma=None), SCAN, BASE, AT, NOW)), allow_nan=False))
    assert None in {edge["position_share"] for edge in data}


def test_given_nothing_that_states_a_sigma_then_there_is_no_sum_either() -> None:
    edge = EdgeReport("frame", "A:B", True, ("A", "A:B"), Pose(), "fixed")
    text = describe_edges(Explanation(PoseAnswer(Transformation("A:B", "A:A", Pose())), (edge,)))
    assert "%" not in text


def test_given_joints_of_every_type_then_lengths_are_meters_and_angles_degrees() -> None:
    found = explain(view(), DEEP, BASE, AT, NOW)
    units = {
        edge.name: [text.split()[1] for text in format_coordinates(edge)]
        for edge in found.edges
        if edge.kind == "joint"
    }
    assert units == {"Slide": ["m"], "Ball": ["deg"] * 3, "Table": ["m", "m", "deg"]}


@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize(
    ("X", "position", "shown"),
    [
        (Pose((0.0, 0.25, 0.0)), (0.25,), ["0.2500 m"]),
        (Pose.from_rpy((0, 0, 0), yaw=-0.5), (-0.5,), ["-28.648 deg"]),
        (Pose(), (0.0,), ["0"]),
        (
            Pose((0.1, 0.2, 0.3), so3.exponential((0.0, 0.5, 0.0))),
            (0.1, 0.2, 0.3, 0.0, 0.5, 0.0),
            ["0.1000 m", "0.2000 m", "0.3000 m", "0.000 deg", "28.648 deg", "0.000 deg"],
        ),
    ],
)
def test_given_a_joints_motion_then_it_reports_the_units_of_its_coordinates(
    X: Pose, position: tuple[float, ...], shown: list[str], forward: bool
) -> None:
    pose = X if forward else X.inverse()
    edge = EdgeReport("joint", "J", forward, ("A:A", "B:B"), pose, "measured", coordinates=position)
    assert format_coordinates(edge) == shown


# --- motion


def test_given_a_motion_then_people_see_units_sigmas_and_axes() -> None:
    lines = describe_motion(compute_motion(view(), SCAN, UTM, "", AT)).splitlines()
    assert lines[0] == f"{SCAN} moves in {UTM}, along the axes of {UTM}"
    names = ["velocity", "turn rate", "acceleration", "angular acceleration"]
    assert [line[:22].strip() for line in lines[1:]] == names
    assert "m/s,  sigma" in lines[1]
    assert "deg/s,  sigma" in lines[2]
    assert lines[3].endswith("m/s2")


def test_given_a_motion_then_scripts_see_si_units_and_the_covariance() -> None:
    found = compute_motion(view(), SCAN, BASE, "Rover:Mast", AT)
    data = json.loads(json.dumps(motion_as_data(found), allow_nan=False))
    assert data["expressed_in"] == "Rover:Mast"
    assert data["angular_velocity"] == pytest.approx(list(found.angular_velocity))
    assert len(data["motion_covariance"]) == len(data["motion_covariance"][0]) == 6


def test_given_what_nobody_knows_then_it_reports_it_and_is_null() -> None:
    none = (math.nan,) * 3
    pose = PoseAnswer(Transformation("A:A", "B:B", Pose(), invalid_reasons=int(Invalid.STALE_JOINT)))
    found = MotionAnswer(pose, "B:B", (1.0, 0.0, -2.0), none, none, none)
    text = describe_motion(found)
    assert "1.0000  0.0000  -2.0000  m/s" in text
    assert text.count("unknown") == 4
    assert motion_as_data(found)["angular_velocity"] == [None] * 3
    assert motion_as_data(found)["motion_covariance"] is None
    assert "NOT VALID       a joint on the path was silent" in describe(pose)


def test_given_joints_never_received_then_the_flags_are_reported_in_words() -> None:
    known = view()
    silent = known._replace(joints=JointHistory(known.model.joints.values(), 60.0))
    text = describe(silent.transformation(SCAN, BASE, TimeQuery(), NOW))
    assert "flags           JOINT_DEFAULT: no sample of a joint on the path was received" in text
    assert (
        "NOT VALID       no sample of a joint on the path was received, and the geometry has no default for it" in text
    )
