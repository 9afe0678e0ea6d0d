"""`modelserver query` on a file, and the manners that all commands share."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from support_samples import GEOMETRY

from modelserver import __version__
from modelserver.messages import Invalid, Origin, PoseAnswer, Quality
from modelserver.transforms import Pose, Transformation
from mstools.cli import COMMANDS, main
from mstools.commands.query import as_dict, describe

# Written as DRDC TR 2005-240, Annex C prints it: the camera in the front nodding scanner's frame.
ANNEX_C = """\
<?xml version="1.0"?>
<config>
  <section name="Geometry">
    <parameter name="BodyList">
      <parameter>
        <parameter name="BodyName" value="FrontNoddingSICK"/>
        <parameter name="Frames">
          <parameter>
            <parameter name="FrameName" value="Origin"/>
            <parameter name="HTransform">
              <parameter name="Row1" value="1 0 0 0"/>
              <parameter name="Row2" value="0 1 0 0"/>
              <parameter name="Row3" value="0 0 1 0"/>
              <parameter name="Row4" value="0 0 0 1"/>
            </parameter>
          </parameter>
        </parameter>
      </parameter>
      <parameter>
        <parameter name="BodyName" value="Digiclops"/>
        <parameter name="Frames">
          <parameter>
            <parameter name="FrameName" value="ImagePlane"/>
            <parameter name="HTransform">
              <parameter name="Row1" value="1 0 0 0"/>
              <parameter name="Row2" value="0 1 0 0"/>
              <parameter name="Row3" value="0 0 1 0"/>
              <parameter name="Row4" value="0 0 0 1"/>
            </parameter>
          </parameter>
        </parameter>
      </parameter>
    </parameter>
    <parameter name="ConstraintList">
      <parameter>
        <parameter name="ConstraintName" value="DigiclopsOnSick"/>
        <parameter name="From" value="FrontNoddingSICK:Origin"/>
        <parameter name="To" value="Digiclops:ImagePlane"/>
        <parameter name="HTransform">
          <parameter name="Row1" value="0.9441 0 -0.3297 0.299"/>
          <parameter name="Row2" value="0 1 0 -0.056"/>
          <parameter name="Row3" value="0.3297 0 0.9441 0.433"/>
          <parameter name="Row4" value="0 0 0 1"/>
        </parameter>
      </parameter>
    </parameter>
  </section>
</config>
"""
PAIR = ("Digiclops:ImagePlane", "FrontNoddingSICK:Origin")
Command: TypeAlias = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Command:
    """A function that runs the command line; returns exit code, output and errors."""

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main([str(each) for each in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        code = ended.value.code
        return code if isinstance(code, int) else 0, out, err

    return run


@pytest.fixture
def annex(tmp_path: Path) -> Path:
    path = tmp_path / "annex_c.xml"
    path.write_text(ANNEX_C)
    return path


# --- query --------------------------------------------------------------------------------------------------


def test_given_annex_c_then_the_camera_stands_where_the_report_reports(run: Command, annex: Path) -> None:
    code, out, err = run("query", *PAIR, "--model", annex)
    assert (code, err) == (0, "")
    lines = [line.split() for line in out.splitlines()]
    assert lines[0] == ["Digiclops:ImagePlane", "in", "FrontNoddingSICK:Origin"]
    assert lines[1] == ["position", "0.2990", "-0.0560", "0.4330", "m"]
    assert lines[2] == ["roll", "pitch", "yaw", "0.000", "-19.250", "0.000", "deg"]


@pytest.mark.realdata
def test_given_the_reports_own_file_then_the_answer_is_the_same(run: Command, data_dir: Path) -> None:
    code, out, _ = run("query", *PAIR, "--model", data_dir / "geometry" / "miro" / "report_annex_C.xml", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["position"] == pytest.approx([0.299, -0.056, 0.433], abs=5e-4)
    assert math.degrees(found["rpy"][1]) == pytest.approx(-19.25, abs=0.01)


def test_given_the_frames_in_reverse_then_it_is_the_inverse_relation(run: Command, annex: Path) -> None:
    there = json.loads(run("query", *PAIR, "--model", annex, "--json")[1])
    back = json.loads(run("query", *reversed(PAIR), "--model", annex, "--json")[1])
    assert (back["frame_of_interest"], back["frame_of_reference"]) == (PAIR[1], PAIR[0])
    assert np.allclose(np.array(there["matrix"]) @ np.array(back["matrix"]), np.eye(4), atol=1e-12)


def test_given_json_then_every_field_is_there_and_what_is_not_known_is_null(run: Command, annex: Path) -> None:
    code, out, err = run("query", *PAIR, "--model", annex, "--json")
    found: dict[str, Any] = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert (code, err) == (0, "")
    assert set(found) == {
        "frame_of_interest", "frame_of_reference", "utime", "position", "quaternion", "rpy", "matrix", "covariance",
        "valid", "invalid_reasons", "flags", "initial_utm", "utm_zone", "origin_id", "pose_epoch",
        "horizontal_protection_level", "heading_protection_level", "model_revision", "geodetic",
        "horizontal_level", "heading_level", "limit_risk", "horizontal_allowance", "unmet", "unmet_reason",
    }  # fmt: skip
    assert found["covariance"] is found["initial_utm"] is found["horizontal_protection_level"] is None
    assert (found["valid"], found["invalid_reasons"], found["flags"], found["utime"]) == (True, [], [], 0)
    assert np.array(found["matrix"]).shape == (4, 4)
    assert len(found["model_revision"]) == 16


def test_given_json_then_its_matrix_has_four_rows(run: Command, annex: Path) -> None:
    rows = json.loads(run("query", *PAIR, "--model", annex, "--json")[1])["matrix"]
    assert np.allclose(
        rows, [[0.9441, 0, -0.3297, 0.299], [0, 1, 0, -0.056], [0.3297, 0, 0.9441, 0.433], [0, 0, 0, 1]], atol=1e-4
    )


@pytest.mark.parametrize(
    ("pair", "near"),
    [
        (("Digiclops:ImagePlan", PAIR[1]), "Digiclops:ImagePlane"),
        (("Digicloqs:ImagePlane", PAIR[1]), "Digiclops:ImagePlane"),
        ((PAIR[0], "frontnoddingsick:origin"), "FrontNoddingSICK"),
        ((PAIR[0], "FrontNodingSICK"), "FrontNoddingSICK:Origin"),
        (("ImagePlane", PAIR[1]), "Digiclops:ImagePlane"),
        (("x" * 5000, PAIR[1]), ""),
        (("\x1b[31m\n:a", PAIR[1]), ""),
    ],
)
def test_given_a_mistyped_name_then_one_line_offers_the_nearest_and_exit_is_1(
    run: Command, annex: Path, pair: tuple[str, str], near: str
) -> None:
    code, out, err = run("query", *pair, "--model", annex)
    assert (code, out) == (1, "")
    assert err.startswith("modelserver: ")
    assert len(err.splitlines()) == 1
    assert err[:-1].isprintable()
    assert len(err) < 400
    assert near in err


def test_given_a_world_frame_and_a_file_then_it_reports_to_ask_the_daemon(run: Command, annex: Path) -> None:
    code, out, err = run("query", PAIR[0], "World:UTM", "--model", annex)
    assert (code, out) == (1, "")
    assert "query the daemon" in err


@pytest.mark.parametrize("name", ["nowhere.xml", "."])
def test_given_a_file_that_cannot_be_read_then_the_error_names_it(run: Command, tmp_path: Path, name: str) -> None:
    code, out, err = run("query", *PAIR, "--model", tmp_path / name)
    assert (code, out) == (1, "")
    assert str(tmp_path / name) in err.splitlines()[0]


def test_given_a_file_that_is_wrong_then_its_problems_are_reported(run: Command, tmp_path: Path) -> None:
    path = tmp_path / "bad.xml"
    path.write_text(ANNEX_C.replace('"Digiclops:ImagePlane"', '"Digiclops:ImagePlan"'))
    code, out, err = run("query", *PAIR, "--model", path)
    assert (code, out) == (1, "")
    assert "bad.xml:" in err
    assert "Digiclops:ImagePlane" in err


def test_given_a_world_frame_that_there_is_not_then_those_that_there_are_are_reported(
    run: Command, annex: Path
) -> None:
    code, _, err = run("query", "World:UTN", "Digiclops:ImagePlane", "--model", annex)
    assert code == 1
    assert "'World:UTN' is an unknown frame; known: World:UTM, World:ENU, Odom:Origin. Nearest: World:UTM" in err


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"vehicle: cart\ngeometry: cart.xml\nbase_frame: Cart:Base\n", "this is a vehicle file, not a geometry file"),
        (b"\xed\xa1\xda\x01" + bytes(40), "this is an LCM event log, not a geometry file"),
        (b"# bodies:\n", "there is nothing in the file but comments"),
    ],
)
def test_given_a_file_of_another_kind_for_a_model_then_one_error_reports_what_it_is(
    run: Command, tmp_path: Path, content: bytes, words: str
) -> None:
    path = tmp_path / "file.yaml"
    path.write_bytes(content)
    code, out, err = run("query", *PAIR, "--model", path)
    assert (code, out) == (1, "")
    assert words in err
    assert err.count("error:") == 1
    assert ("give the geometry file that it names, 'cart.xml'" in err) == (b"cart.xml" in content)


def test_given_no_daemon_then_one_line_reports_it_and_exit_is_1(run: Command, lcm_url: str) -> None:
    code, out, err = run("query", *PAIR, "--url", lcm_url, "--timeout", "0.02")
    assert (code, out) == (1, "")
    assert "no reply" in err
    assert lcm_url in err
    assert len(err.splitlines()) == 1


# --- usage --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["query"],
        ["query", "A:B"],
        ["query", "A:B", "C:D", "E:F"],
        ["query", "A:B", "C:D", "--nonsense"],
        ["query", "A:B", "C:D", "--policy", "guess"],
        ["query", "A:B", "C:D", "--at", "noon"],
        ["query", "A:B", "C:D", "--at", "1763790000"],
        ["query", "A:B", "C:D", "--wait-ms", "-1"],
        ["query", "A:B", "C:D", "--timeout", "0"],
        ["query", "A:B", "C:D", "--timeout", "nan"],
        ["run"],
        ["run", "-c", "x.yaml", "--log-level", "loud"],
        ["check"],
    ],
)
def test_given_wrong_usage_then_exit_is_2_and_the_way_to_help_is_reported(run: Command, arguments: list[str]) -> None:
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert "--help" in err or "Error" in err


def test_given_version_then_it_is_printed(run: Command) -> None:
    assert run("--version") == (0, f"modelserver {__version__}\n", "")


def test_given_help_then_every_command_is_listed_with_its_summary(run: Command) -> None:
    code, out, _ = run("--help")
    assert code == 0
    for name, summary in COMMANDS.items():
        assert name in out
        assert summary.split()[0] in out


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_given_help_of_a_command_then_it_contains_an_example(run: Command, name: str) -> None:
    code, out, err = run(name, "--help")
    assert (code, err) == (0, "")
    assert re.search(f"Examples?: modelserver {name}", " ".join(out.split()))
    assert f"modelserver {name}" in out.splitlines()[0] + out.splitlines()[1]


# --- demands ------------------------------------------------------------------------------------------------


def write_mast(tmp_path: Path) -> Path:
    path, sigma = tmp_path / "cart.yaml", "sigma: {xyz: [0, 0.01, 0.01], rpy_deg: [0.1, 0.1, 1]}"
    path.write_text(GEOMETRY.replace("Mast: {xyz: [0.5, 0.1, 1.0]}", f"Mast: {{xyz: [0.5, 0.1, 1.0], {sigma}}}"))
    return path


@pytest.mark.parametrize(
    ("demand", "unmet", "reason"),
    [
        (("--max-horizontal", 0.04, "--max-heading", 2.6, "--max-age", 0.1, "--min-integrity", 0.99), [], ""),
        (
            ("--max-horizontal", 0.03),
            ["HORIZONTAL"],
            "the horizontal error is up to 0.03035 m at integrity 0.99, asked for: 0.03 m",
        ),
        (
            ("--max-heading", 2.5),
            ["HEADING"],
            "the heading error is up to 2.576 deg at integrity 0.99, asked for: 2.5 deg",
        ),
    ],
)
def test_given_a_demand_then_the_verdict_is_printed_and_the_exit_code_is_3_where_it_is_unmet(
    run: Command, tmp_path: Path, demand: tuple[object, ...], unmet: list[str], reason: str
) -> None:
    arguments = ("query", "Cart:Mast", "Cart:Base", "--model", write_mast(tmp_path), *demand)
    code, out, err = run(*arguments)
    assert (code, err) == (3 if unmet else 0, "")
    assert out.splitlines()[1] == "  position        0.5000  0.1000  1.0000  m"
    assert out.splitlines()[-1] == (f"  UNMET           {reason}" if unmet else "  demand          met")
    code, out, _ = run(*arguments, "--json")
    assert code == (3 if unmet else 0)
    assert (json.loads(out)["unmet"], json.loads(out)["unmet_reason"]) == (unmet, reason)


@pytest.mark.parametrize(
    ("demand", "code", "message"),
    [
        (("--max-age", -1), 1, "max_age -1 is not from 0 (not asked for)"),
        (("--max-horizontal", "nan"), 1, "max_horizontal nan is not from 0"),
        (("--max-heading", 200), 1, "max_heading 3.49066 is not from 0 (not asked for) to less than 3.14159"),
        (("--min-integrity", 99), 1, "min_integrity 99 is not from 0 (not asked for) to less than 1"),
        (("--max-age", 1, "--explain"), 2, "--explain and --motion go without a demand"),
        (("--max-age", 1, "--motion"), 2, "--explain and --motion go without a demand"),
    ],
)
def test_given_a_demand_that_cannot_be_then_the_error_names_it(
    run: Command, tmp_path: Path, demand: tuple[object, ...], code: int, message: str
) -> None:
    found, out, err = run("query", "Cart:Mast", "Cart:Base", "--model", write_mast(tmp_path), *demand)
    assert (found, out) == (code, "")
    assert message in " ".join(err.replace("│", " ").split())


# --- what the daemon's answers look like --------------------------------------------------------------------


def world_answer(**more: Any) -> PoseAnswer:
    transformation = Transformation(
        "Cart:Base", "World:UTM", Pose.from_rpy((1.5, -2.0, 0.25), 0, 0, math.pi / 2), np.eye(6) * 0.04,
        1_700_000_000_500_000, int(Invalid.STALE_GPS | Invalid.STALE_IMU), 3, 0xABC, "rev",
    )  # fmt: skip
    return PoseAnswer(transformation, Origin(445_000.5, 5_030_000.0, 71.0, 18, False, 0xABC), **more)


def test_given_a_world_pose_then_people_see_time_grid_bounds_and_what_speaks_against_it() -> None:
    text = describe(
        world_answer(quality=Quality.PREDICTED, horizontal_protection_level=1.5, heading_protection_level=0.1)
    )
    assert "2023-11-14T22:13:20.500000+00:00  (1700000000500000)" in text
    assert "445002.000 E  5029998.000 N  71.250 up  zone 18S" in text
    assert "geodetic        -44.88131513  -75.69637246  deg,  height 71.250 m (WGS 84)" in text
    assert "heading         0.49 deg from true north,  compass 348.70 deg" in text
    assert "sigma           0.2000  0.2000  0.2000  m,  11.459  11.459  11.459  deg" in text
    assert "protection      1.50 m, heading 5.73 deg" in text
    assert "flags           PREDICTED" in text
    assert "epoch           3, origin 0000000000000abc" in text
    assert text.splitlines()[-1].startswith(
        "  NOT VALID       the last usable GPS fix is too old; the last usable inertial"
    )


def test_given_a_world_pose_then_scripts_see_the_same() -> None:
    found = json.loads(json.dumps(as_dict(world_answer(horizontal_protection_level=math.nan)), allow_nan=False))
    assert found["initial_utm"] == [445_000.5, 5_030_000.0, 71.0]
    assert (found["utm_zone"], found["valid"], found["horizontal_protection_level"]) == ("18S", False, None)
    assert found["geodetic"]["height"] == pytest.approx(71.25)
    assert found["invalid_reasons"] == ["STALE_GPS", "STALE_IMU"]
