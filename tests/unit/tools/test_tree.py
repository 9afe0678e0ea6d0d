"""`modelserver tree`: what hangs on what, in the terminal and as an image, however large the vehicle."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import lcm
import pytest
from support_lcm import reserved_url
from support_samples import START, VEHICLE, write_vehicle

from modelserver.client.mirror_state import MirrorState
from modelserver.formats import load_model
from modelserver.formats.yaml_geometry import ModelSnapshot, encode_snapshot
from modelserver.geometry import ModelBuilder
from modelserver.geometry.model import Model
from modelserver.joints import JointHistory
from modelserver.messages import JointSample, JointsSample, SensorHeader
from modelserver.transforms import Pose
from modelserver.wire.codec import encode, split_snapshot
from mstools.cli import main
from mstools.commands.tree import build_nodes, describe_rates, draw_lines, draw_svg
from mstools.terminal.output import replace_unencodable

Run = Callable[..., tuple[int, str, str]]

ARM = """\
modelserver: geometry/1
name: arm
bodies:
  Base: {frames: {Mount: {xyz: [0, 0, 0.4]}, Rail: {xyz: [1, 0, 0]}}}
  Turret: {frames: {Foot: {}, Top: {xyz: [0, 0, 0.2]}}}
  Lift: {frames: {Foot: {}}}
  Grip: {frames: {Root: {}}}
  Strut: {frames: {Low: {}, High: {xyz: [-1, 0, 0.6]}}}
  Lamp: {frames: {Origin: {}}}
constraints:
  Turn: {from: Base:Mount, to: Turret:Foot, joint: {type: revolute, axis: [0, 0, 1], limits_deg: [-170, 90],
    rate_limit_deg: 60}}
  Rise: {from: Turret:Top, to: Lift:Foot, joint: {type: prismatic, axis: [0, 0, 1], limits: [0, 0.5]}}
  Close: {from: Lift:Foot, to: Grip:Root, joint: {type: revolute, axis: [0, 0, 1], mimic: {joint: Turn,
    multiplier: -1, offset_deg: 5}}}
  Foot: {from: Strut:Low, to: Base:Rail}
  Head: {from: Strut:High, to: Turret:Top, xyz: [0, 0.003, 0]}
"""

TREE = """\
Base
├─ Turret  (Turn: revolute, -170 to 90 deg, 60 deg/s at most)
│  │  ⟲ loop: Head (fixed) to Strut:High, misses by 3 mm and 0 deg with joints at their defaults
│  └─ Lift  (Rise: prismatic, 0 to 0.5 m)
│     └─ Grip  (Close: revolute, follows Turn times -1 +5 deg)
└─ Strut  (Foot: fixed, from here)

1 orphan, not connected to the root:
Lamp
"""


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.yaml"
    path.write_text(ARM)
    return path


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def tree(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            main(["tree", *(str(each) for each in arguments)])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(end.value.code or 0), out, err

    return tree


def test_given_joints_a_loop_and_an_orphan_then_the_tree_shows_them(run: Run, arm: Path) -> None:
    code, out, _ = run(arm)
    head, _, rest = out.partition("\n")
    assert code == 0
    assert head == f"arm: 6 bodies, 9 frames, 5 constraints, revision {load_model(arm).revision}"
    assert rest == TREE


def test_given_frames_then_they_stand_below_their_bodies(run: Run, arm: Path) -> None:
    _, out, _ = run(arm, "--frames")
    assert out.splitlines()[1:6] == ["Base", "│  · Mount", "│  · Rail", *TREE.splitlines()[1:3]]
    assert out.splitlines()[-2:] == ["Lamp", "   · Origin"]


def test_given_json_then_it_lists_the_frames_of_each_body_root_first(run: Run, arm: Path) -> None:
    code, out, _ = run(arm, "--json")
    bodies = json.loads(out)
    assert (code, list(bodies)) == (0, ["Base", "Turret", "Lift", "Grip", "Strut", "Lamp"])
    assert bodies["Strut"] == ["Strut:Low", "Strut:High"]
    assert run(arm, "--json", "--svg", "-")[0] == 2


def test_given_a_vehicle_file_then_its_geometry_is_drawn(run: Run, tmp_path: Path) -> None:
    code, out, _ = run(write_vehicle(tmp_path, VEHICLE))
    assert code == 0
    assert out.splitlines()[1:] == ["Cart", "└─ Camera  (Mounted: fixed)"]


def test_given_an_image_then_it_is_one_svg_with_every_body_and_nothing_that_steers(run: Run, arm: Path) -> None:
    code, out, _ = run(arm, "--svg", "-", "--frames")
    assert code == 0
    image = ElementTree.fromstring(out)
    assert image.tag == "{http://www.w3.org/2000/svg}svg"
    text = " ".join("".join(each.itertext()) for each in image.iter("{http://www.w3.org/2000/svg}text"))
    for part in ("Turret", "Turn: revolute, -170 to 90 deg", "loop: Head", "Lamp", "orphan", "Mount, Rail"):
        assert part in text
    height = float(image.attrib["height"])
    assert all(float(each.attrib["y"]) < height for each in image.iter("{http://www.w3.org/2000/svg}text"))


def test_given_a_target_that_is_there_then_it_is_replaced_by_force_alone(run: Run, arm: Path, tmp_path: Path) -> None:
    target = tmp_path / "arm.svg"
    assert run(arm, "--svg", target)[0] == 0
    code, _, err = run(arm, "--svg", target)
    assert code == 1
    assert "--force" in err
    assert run(arm, "--svg", target, "--force")[0] == 0


@pytest.mark.parametrize("arguments", [(), ("some.yaml", "--live")])
def test_given_neither_or_both_sources_then_it_is_wrong_usage(run: Run, arguments: tuple[str, ...]) -> None:
    code, _, err = run(*arguments)
    assert code == 2
    assert "--live" in err


def test_given_a_file_that_is_wrong_then_its_problems_are_reported(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(ARM.replace("to: Lift:Foot", "to: Lfit:Foot"))
    code, out, err = run(path)
    assert (code, out) == (1, "")
    assert "Lfit" in err


# --- as large as vehicles get ---------------------------------------------------------------------------------------


def chain(count: int, deep: bool) -> Model:
    builder = ModelBuilder("chain")
    for n in range(count):
        builder.add_body(f"Body{n}").add_frame("Near").add_frame("Far", Pose((0.1, 0.0, 0.0)))
        if n:
            builder.add_constraint(f"Joint{n}", f"Body{n - 1 if deep else 0}:Far", f"Body{n}:Near")
    return builder.build()


@pytest.mark.parametrize(("count", "deep"), [(200, False), (200, True), (1500, True)])
def test_given_many_bodies_in_breadth_or_depth_then_each_has_one_line(count: int, deep: bool) -> None:
    drawn = build_nodes(chain(count, deep))
    text = list(draw_lines(drawn))
    assert len(text) == count
    assert sum("(Joint" in line for line in text) == count - 1
    image = ElementTree.fromstring(draw_svg("chain", drawn))
    assert len(list(image.iter("{http://www.w3.org/2000/svg}circle"))) == count


def test_given_a_terminal_without_such_letters_then_lines_are_ascii() -> None:
    assert replace_unencodable("├─ a → b\n│  └─ ⟲ é", "ascii") == "|- a > b\n|  `- @ ?"
    assert replace_unencodable("├─ a", "utf-8") == "├─ a"
    assert replace_unencodable("└─ a", "no such encoding") == "`- a"


# --- the running daemon ---------------------------------------------------------------------------------------------


class PublishingDaemon:
    """A daemon that broadcasts a geometry in parts, every 20 ms, until it is left."""

    def __init__(self, url: str, model: Model):
        content = encode_snapshot(ModelSnapshot("arm", model, "Base:Mount", "Base:Mount", 60.0, "JOINTS"))
        self.parts = [encode(part) for part in reversed(split_snapshot(content, model.revision, START))]
        self.bus = lcm.LCM(url)
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.run)

    def run(self) -> None:
        while not self.ended.wait(0.02):
            self.bus.publish("V1_MODEL_SNAPSHOT", b"no message at all")
            for part in self.parts:
                self.bus.publish("V1_MODEL_SNAPSHOT", part)

    def __enter__(self) -> PublishingDaemon:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.thread.join()


def test_given_a_daemon_then_the_geometry_that_it_broadcasts_is_drawn(
    run: Run, arm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mstools.commands.tree.LISTENING_S", 0.02)
    with reserved_url() as url, PublishingDaemon(url, load_model(arm)):
        code, out, _ = run("--live", "--url", url, "--prefix", "V1_")
    title, _, lines = out.partition("\n")
    assert code == 0
    assert title.endswith("; no POSE")
    assert lines.replace(", at its default: no reading", "") == TREE
    assert "(Rise: prismatic, 0 to 0.5 m, at its default: no reading)" in lines


def test_given_readings_then_each_joint_has_its_rate_age_and_source(arm: Path) -> None:
    model = load_model(arm)
    joints = JointHistory(model.constraints, 10.0)
    for n in range(11):
        readings = (JointSample("Turn", 0.01 * n), *((JointSample("Rise", 0.1),) if n == 5 else ()))
        joints, rejected = joints.update(
            JointsSample(SensorHeader(START + n * 50_000, "head", n), readings), START + 500_000
        )
        assert rejected == ()
    snapshot = ModelSnapshot("arm", model, "Base:Mount", "Base:Mount", 60.0, "JOINTS")
    state = MirrorState(snapshot=snapshot, joints=joints, clock_offset=1_000_000)
    notes = describe_rates(state, START - 250_000)
    assert notes["Turn"] == ", 20.0 Hz, 0.25 s ago by head"
    assert notes["Rise"] == ", 0.50 s ago by head"
    assert "Close" not in notes  # it follows Turn


def test_given_nobody_then_it_reports_where_it_listened_and_what_to_do(run: Run) -> None:
    with reserved_url() as url:
        code, out, err = run("--live", "--url", url, "--wait", "0.05")
    assert (code, out) == (1, "")
    for part in ("MODEL_SNAPSHOT", url, "modelserver run", "publish.snapshot_s"):
        assert part in err
