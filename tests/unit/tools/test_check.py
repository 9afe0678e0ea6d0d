"""`modelserver check`."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support_formats import YAML, miro, tree, tree_frame

from mstools.cli import main

BAD = YAML.replace("[0.2, 0, 1.1]", "[0.2, 0]").replace("to: Camera:Origin", "to: Camrea:Origin")
NOTED = YAML.replace("modelserver: geometry/1\n", "")


@pytest.fixture
def check(tmp_path, capsys, monkeypatch):
    """Return a function that checks texts, each in a file of its own, and gives exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MRN", raising=False)

    def run(*arguments, **files):
        for name, text in files.items():
            (tmp_path / name).write_text(text)
        with pytest.raises(SystemExit) as ended:
            main(["check", *files, *arguments])
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run


def test_a_clean_file_is_one_line_and_exit_0(check):
    assert check(cart=YAML) == (0, "cart: 2 bodies, 3 frames, 1 constraint; clean\n", "")


def test_every_problem_is_printed_with_place_fix_and_nearest_and_exit_1(check):
    code, out, _ = check(cart=BAD)
    assert code == 1
    lines = out.splitlines()
    assert lines[0] == "cart:6: error: xyz has 2 numbers, not 3"
    assert lines[1] == "    in:      body Cart, frame Mast"
    assert lines[2] == "    fix:     write xyz: [number, number, number], in meters"
    assert lines[3].startswith("cart:11: error: ")
    assert any(line.startswith("    nearest: Camera:Origin") for line in lines)
    assert lines[-1] == "cart: 2 errors"


def test_a_warning_exits_1_and_the_size_is_reported(check):
    code, out, _ = check(cart=YAML.replace("constraints:", "  Lamp: {frames: {Origin: }}\nconstraints:"))
    assert code == 1
    assert out.splitlines()[-1] == "cart: 3 bodies, 4 frames, 1 constraint; 1 warning"


def test_given_two_constraints_on_a_frame_then_strict_alone_refuses_the_second(check):
    text = YAML.replace("constraints:", "  Lamp: {frames: {Origin: }}\nconstraints:")
    text += "  LampFixed: {from: Cart:Mast, to: Lamp:Origin}\n"
    assert check(cart=text)[:2] == (0, "cart: 3 bodies, 4 frames, 2 constraints; clean\n")
    code, out, _ = check("--strict", cart=text)
    assert code == 1
    assert "frame Cart:Mast already has constraint CameraFixed" in out
    assert out.splitlines()[-1] == "cart: 1 error"


def test_given_a_vehicle_file_then_strict_counts_for_its_geometry(check, tmp_path):
    text = YAML.replace("constraints:", "  Lamp: {frames: {Origin: }}\nconstraints:")
    (tmp_path / "geometry.yaml").write_text(text + "  LampFixed: {from: Cart:Mast, to: Lamp:Origin}\n")
    vehicle = "vehicle: cart\ngeometry: geometry.yaml\nbase_frame: Cart:Origin\n"
    assert check(**{"vehicle.yaml": vehicle})[0] == 0
    code, out, _ = check("--strict", **{"vehicle.yaml": vehicle})
    assert code == 1
    assert "already has constraint CameraFixed" in out


def test_notes_are_counted_printed_when_asked_for_and_change_no_exit_code(check):
    assert check(cart=NOTED) == (0, "cart: 2 bodies, 3 frames, 1 constraint; clean; 1 note (--notes shows them)\n", "")
    code, out, _ = check("--notes", cart=NOTED)
    assert code == 0
    assert "note: the file does not state its format" in out


def test_several_files_are_checked_though_one_is_missing(check):
    code, out, _ = check("nowhere", "--set", "MRN=Rover", a=YAML, b=miro())
    assert code == 1
    assert "a: 2 bodies" in out
    assert "b: 2 bodies" in out
    assert "nowhere: error: the file cannot be read: No such file or directory" in out


def test_a_process_file_of_2005_is_one_error_with_the_keys_that_replace_it(check):
    text = '<config><section name="ModelServer"><parameter name="UpdateRateHz" value="10"/></section></config>'
    code, out, _ = check(process=text)
    assert (code, out.count("error:")) == (1, 1)
    assert "this is a process file of the original ModelServer (2005)" in out
    assert "these keys replace its parameters: vehicle, geometry, base_frame" in " ".join(out.split())


def test_set_fills_variables(check):
    text = tree(tree_frame("$MRN"), tree_frame("Mast", "$MRN"), tree_frame("Camera", "Mast"))
    code, out, _ = check(rover=text)
    assert code == 1
    assert "--set MRN=NAME" in out
    assert check("--set", "MRN=K11", rover=text)[0] == 0


@pytest.mark.parametrize("text", ["MRN", "=x", "M RN=x", "$MRN=x"])
def test_a_malformed_set_is_wrong_usage(check, text):
    code, _, err = check("--set", text, a=YAML)
    assert code == 2
    assert "NAME=VALUE" in err


def test_no_file_is_wrong_usage(check):
    assert check()[0] == 2


def test_json_holds_all_for_scripts(check):
    code, out, _ = check("--json", bad=BAD, good=NOTED)
    assert code == 1
    bad, good = json.loads(out)["files"]
    assert (bad["file"], bad["clean"], bad["errors"], bad["model"]) == ("bad", False, 2, None)
    assert bad["problems"][0] == {
        "severity": "error",
        "file": "bad",
        "line": 6,
        "element": "body Cart, frame Mast",
        "message": "xyz has 2 numbers, not 3",
        "fix": "write xyz: [number, number, number], in meters",
        "nearest": [],
        "edit": None,
    }
    assert (good["clean"], good["notes"], good["model"]["frames"]) == (True, 1, 3)


def test_json_holds_the_edit_that_fixes_a_misspelled_name(check):
    _, out, _ = check("--json", bad=YAML.replace("bodies:", "boddies:"))
    (bad,) = json.loads(out)["files"]
    (problem,) = [each for each in bad["problems"] if each["severity"] == "error"]
    assert problem["edit"] == {"line": problem["line"], "old": "boddies", "new": "bodies"}


def test_control_characters_from_a_file_do_not_reach_the_terminal(check):
    _, out, _ = check(cart=YAML.replace("Mast: {", '"Ma\\e[31mst\\x07": {'))
    assert out
    assert all(each.isprintable() for each in out.replace("\n", ""))


def test_help_has_an_example(check):
    code, out, _ = check("--help")
    assert code == 0
    assert "Example: modelserver check" in out


def test_nothing_heavy_is_imported(tmp_path):
    (tmp_path / "cart").write_text(YAML)
    script = (
        "import sys, mstools.cli as cli\n"
        "try: cli.main(['check', 'cart'])\n"
        "except SystemExit: print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert "clean" in done.stdout
    assert {"filterpy", "matplotlib", "scipy", "pyproj", "lxml", "lcm"}.isdisjoint(done.stderr.split())


def test_a_vehicle_file_is_checked_with_its_geometry(check, tmp_path):
    vehicle = Path(__file__).parents[3] / "config" / "husky" / "vehicle.yaml"
    code, out = check(str(vehicle))[:2]
    assert code == 0
    assert "clean" in out
    wrong = tmp_path / "vehicle.yaml"
    text = vehicle.read_text().replace("geometry: ", f"geometry: {vehicle.parent}/").replace("rate_hz", "rate_hertz")
    wrong.write_text(text)
    code, out = check(str(wrong))[:2]
    assert code == 1
    assert "unknown key 'rate_hertz'" in out
    wrong.write_text(text.replace("rate_hertz", "rate_hz").replace("Husky:Base  ", "Husky:Bass  "))
    code, out = check(str(wrong))[:2]
    assert code == 1
    assert "Husky:Base" in out


VEHICLE = """\
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Mast
"""


def test_an_empty_file_leads_to_both_pages(check):
    out = check(**{"vehicle.yaml": ""})[1]
    assert "docs/geometry-files.md" in out
    assert "docs/vehicle-file.md" in out


def test_what_is_wrong_with_values_and_with_frames_is_reported_at_once_with_lines(check, tmp_path):
    (tmp_path / "geometry.yaml").write_text(YAML)
    text = (
        VEHICLE
        + """\
sensors:
  gps: {channel: GPS, frame: Cart:Mst, latency: 80}
  wheels: {kinematics: skidsteer}
localization:
  mode: no_gsp
  filter:
    horizon: -1
    heading_limit: 30
    gps_correlation_time: soon
"""
    )
    code, out, _ = check(**{"vehicle.yaml": text})
    assert code == 1
    lines = [line for line in out.splitlines() if line.startswith("vehicle.yaml:") and "error: " in line]
    reported = {int(line.split(":")[1]): line for line in lines}
    # latency and frame are on one line, but nothing hides anything
    assert [int(line.split(":")[1]) for line in lines] == [5, 5, 6, 8, 10, 11, 12]
    assert "80 ms is 0.08" in out
    assert "body Cart has no frame 'Mst'" in out
    assert "horizon must be finite and above 0" in reported[10]
    assert "30 degrees are 0.524" in reported[11]
    assert "write skid_steer" in out
    assert "write no_gps" in out


def test_a_frame_that_is_not_there_is_reported_with_its_line(check, tmp_path):
    (tmp_path / "geometry.yaml").write_text(YAML)
    out = check(**{"vehicle.yaml": VEHICLE.replace("Mast", "Mst")})[1]
    assert out.startswith("vehicle.yaml:3: error: body Cart has no frame 'Mst'")


def test_a_vehicle_without_sensors_is_noted(check, tmp_path):
    (tmp_path / "geometry.yaml").write_text(YAML)
    code, out, _ = check("--notes", **{"vehicle.yaml": VEHICLE})
    assert code == 0
    assert "note: no localization sensor is configured, so there is no pose" in out


def test_one_wheel_of_a_steered_vehicle_and_wheels_without_names_are_warned_of(check, tmp_path):
    (tmp_path / "geometry.yaml").write_text(YAML)
    for wheels, words in (
        ("{kinematics: ackermann, frames: {left: Cart:Mast}}", "nothing measures the turn rate"),
        ("{kinematics: differential}", "frames names no wheels"),
        (
            "{kinematics: skid_steer, frames: {left: Cart:Mast}, steering: {wheels: [left]}}",
            "a skid-steered vehicle has no wheels that steer",
        ),
    ):
        code, out, _ = check(**{"vehicle.yaml": f"{VEHICLE}sensors:\n  wheels: {wheels}\n"})
        assert code == 1
        assert "vehicle.yaml:5: warning: " in out
        assert words in out


def test_a_speedometer_and_a_turn_rate_alone_are_notes_of_what_they_are_used_for(check, tmp_path):
    (tmp_path / "geometry.yaml").write_text(YAML)
    imu = "imu: {channel: IMU, frame: Cart:Mast, yaw_rate_only: true}"
    code, out, _ = check("--notes", **{"vehicle.yaml": f"{VEHICLE}sensors:\n  {imu}\n  speedometer: {{sigma: 0.2}}\n"})
    assert code == 0
    assert "vehicle.yaml:5: note: sensors.imu: yaw rate only: used for the heading" in out
    assert "vehicle.yaml:6: note: sensors.speedometer: one speed: used for the speed and while stationary" in out
    code, out, _ = check(**{"vehicle.yaml": f"{VEHICLE}sensors:\n  speedometer: {{sigma: 0.2}}\n"})
    assert code == 1
    assert "vehicle.yaml:5: warning: one speed and no IMU" in out
    code, out, _ = check(**{"vehicle.yaml": f"{VEHICLE}sensors:\n  speedometer: {{}}\n  wheels: {{}}\n"})
    assert code == 1
    assert "speedometer is for a vehicle without measured wheels" in out


def test_everything_wrong_with_drivers_is_reported_at_once_with_lines(check, tmp_path):
    (tmp_path / "geometry.yaml").write_text(YAML)
    (tmp_path / "cart.dbc").write_text('BO_ 5 Wheels: 8 A\n SG_ Left : 0|16@1+ (1,0) [0|0] "" A\n')
    text = (
        VEHICLE
        + """\
sensors:
  wheels: {kinematics: differential, frames: {left: Cart:Mast}}
drivers:
  gps: {device: novatel, port: /dev/ttyUSB0, buads: [9600]}
  imu: {device: gx1, port: /dev/ttyUSB0}
  second: {device: gx1, port: /dev/ttyUSB0}
  empty:
  wheels: {device: wheels, can: can0, dbc: card.dbc, wheels: {left: {speed: {signal: Wheels.Left}}}}
  others:
    device: wheels
    can: can0
    dbc: cart.dbc
    wheels:
      lefft:
        speed: {signal: Wheels.Lefft}
  own: {device: wheels, can: can0, dbc: cart.dbc, channel: MINE, wheels: {any: {speed: {signal: Wheels.Left}}}}
  axis:
    device: axis
    address: "127.0.0.1:5020"
    joint: CameraFixd
    registers: {angle: {address: 0, scale_deg: 0.01}}
"""
    )
    code, out, _ = check(**{"vehicle.yaml": text})
    assert code == 1
    assert re.findall(r"^vehicle.yaml:(\d+): (\w+): ", out, re.MULTILINE) == [
        ("5", "warning"),
        ("7", "error"),
        ("9", "warning"),
        ("10", "error"),
        ("11", "error"),
        ("17", "warning"),
        ("18", "error"),
        ("23", "warning"),
    ]
    for words in (
        "unknown key 'buads'",
        "drivers imu and second have one line",
        "drivers.empty is empty",
        "card.dbc' cannot be read",
        "cart.dbc: message Wheels has no signal 'Lefft'",
        "sensors.wheels.frames has no 'lefft'",
        "the geometry has no constraint 'CameraFixd'",
        "write CameraFixed",
    ):
        assert words in out


AXIS = """
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Origin
drivers:
  axis:
    device: axis
    address: "127.0.0.1:5020"
    joint: Nod
    registers: {angle: {address: 0, scale_deg: 0.01}}
"""


def test_a_geometry_without_constraints_does_not_have_the_joint_and_an_unreadable_one_may(check):
    one_body = "bodies: {Cart: {frames: {Origin: {}}}}"
    _, out, _ = check(**{"vehicle.yaml": AXIS, "geometry.yaml": one_body})
    assert "the geometry has no constraint 'Nod'" in out
    _, out, _ = check(**{"vehicle.yaml": AXIS, "geometry.yaml": "bodies: ["})
    assert "has no constraint" not in out
