"""Miro's process configuration (report, Annex B.3): refused with the command that converts it, which works."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from modelserver.config.vehicle_file import load_config
from modelserver.files.kinds import FileKind, detect_file_kind
from mstools.cli import main

RAPTOR = Path(__file__).resolve().parents[3] / "config" / "raptor"
Run = Callable[..., tuple[int, str, str]]

PROCESS = """\
<!DOCTYPE MiroConfigDocument>
<config>
  <section name="ModelServer">
    <parameter name="ModelServer">
      <parameter name="VehicleName" value="raptor"/>
      <parameter name="GeometryFile" value="geometry.xml"/>
      <parameter name="EventDriven" value="false"/>
      <parameter name="UpdateRateHz" value="10"/>
      <parameter name="StationaryTime" value="5"/>
      <parameter name="RawMode" value="true"/>
      <parameter name="InitialUTM"> <!-- a vector: one entry each -->
        <parameter value="350000"/>
        <parameter value="5570000"/>
        <parameter value="700"/>
      </parameter>
      <parameter name="UtmZone" value="12"/>
      <parameter name="UtmHemisphere" value="North"/>
      <parameter name="RollingFrame" value="Raptor:RearAxleCenter"/>
      <parameter name="Gps">
        <parameter name="Channel" value="GPS"/>
        <parameter name="Frame" value="GPSAntenna:PhaseCenter"/>
      </parameter>
      <parameter name="ImuChannel" value="IMU"/>
      <parameter name="ImuFrame" value="Microstrain:Sensor"/>
      <parameter name="Wheels">
        <parameter name="Frames">
          <parameter name="front_left" value="Raptor:FrontLeftWheelContact"/>
        </parameter>
      </parameter>
    </parameter>
  </section>
</config>
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder, the current one, with the Raptor's geometry file of 2005 and a process configuration."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(RAPTOR / "geometry.xml", tmp_path)
    (tmp_path / "process.xml").write_text(PROCESS)
    return tmp_path


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command line; return its exit code, standard output and error."""

    def modelserver(*arguments: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        out, err = capsys.readouterr()
        return int(ended.value.code or 0), out, err

    return modelserver


def write(folder: Path, *parameters: str, file: str = "process.xml") -> None:
    """Write a process configuration with these parameters in one section."""
    inside = "\n".join(parameters)
    (folder / file).write_text(f'<config><section name="ModelServer">\n{inside}\n</section></config>\n')


GEOMETRY = '<parameter name="GeometryFile" value="geometry.xml"/>'


# --- refused, with the command -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "-c", "process.xml"),
        ("check", "process.xml"),
        ("query", "Raptor:CG", "Raptor:Origin", "--model", "process.xml"),
        ("tree", "process.xml"),
    ],
)
def test_given_a_process_configuration_then_it_is_refused_with_a_command_whose_result_loads(
    folder: Path, run: Run, arguments: tuple[str, ...]
) -> None:
    code, out, err = run(*arguments)
    assert code == 1
    printed = out + err
    assert "this is a Miro process configuration" in printed
    (line,) = [each for each in printed.splitlines() if "modelserver convert" in each]
    program, *command = shlex.split(line[line.index("modelserver convert") :])
    assert program == "modelserver"
    code, out, err = run(*command)
    assert (code, out) == (0, "")
    assert err == "process.yaml: 0 warnings; modelserver check process.yaml\n"
    # the note: this process is in raw mode, which does not use its wheels
    summary = "process.yaml: 11 bodies, 61 frames, 10 constraints; clean; 1 note (--notes shows them)\n"
    assert run("check", "process.yaml") == (0, summary, "")
    config = load_config(folder / "process.yaml")
    assert (config.vehicle, config.geometry) == ("raptor", str(folder / "geometry.xml"))
    assert (config.base_frame, config.rolling_frame) == ("Raptor:CG", "Raptor:RearAxleCenter")
    assert (config.publish.mode, config.publish.rate_hz) == ("timer", 10.0)
    assert (config.localization.mode, config.localization.filter.recapture_time) == ("raw", 5.0)
    assert config.origin.initial_utm == (350000.0, 5570000.0, 700.0)
    assert (config.origin.zone, config.origin.hemisphere) == (12, "north")
    assert config.sensors.gps is not None
    assert (config.sensors.gps.channel, config.sensors.gps.frame) == ("GPS", "GPSAntenna:PhaseCenter")
    assert config.sensors.imu is not None
    assert (config.sensors.imu.channel, config.sensors.imu.frame) == ("IMU", "Microstrain:Sensor")
    assert config.sensors.wheels is not None
    assert config.sensors.wheels.frames == {"front_left": "Raptor:FrontLeftWheelContact"}


def test_given_a_path_with_a_space_then_the_command_is_quoted(folder: Path, run: Run) -> None:
    (folder / "my process.xml").write_text(PROCESS)
    _, _, err = run("run", "-c", "my process.xml")
    assert "modelserver convert 'my process.xml' 'my process.yaml'" in err


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (PROCESS, FileKind.MIRO_PROCESS),
        ("<config><section name='a'/></config>", FileKind.XML),
        (
            "<config><section><parameter><parameter name='BodyName' value='A'/></parameter></section></config>",
            FileKind.XML,
        ),
        # a geometry whose names are mistyped is left to its reader, which reports them
        ("<config><section><parameter><parameter name='FrameName'/></parameter></section></config>", FileKind.XML),
        ("<config><section><config_group/><parameter/></section></config>", FileKind.XML),
    ],
)
def test_a_process_configuration_is_known_by_what_stands_in_it(content: str, kind: FileKind) -> None:
    assert detect_file_kind(content.encode()) is kind
    assert detect_file_kind((RAPTOR / "geometry.xml").read_bytes()) is FileKind.XML


# --- the result ----------------------------------------------------------------------------------------------------


def test_each_line_reports_where_it_comes_from_and_what_is_left_is_listed_with_a_warning(
    folder: Path, run: Run
) -> None:
    write(
        folder,
        GEOMETRY,
        '<parameter name="PublishRateHz" value="20"/>',
        '<parameter name="ProcessNoise"><parameter value="0.1"/><parameter value="0.2"/></parameter>',
        '<parameter name="Mode" value="full"/>',
        '<parameter name="HealthHz" value="fast"/>',
        '<parameter name="StateHz" value="1000"/>',
        '<parameter name="PublishRateHz" value="30"/>',
        '<parameter name="Imu"><parameter name="Frame" value="Microstrain:Senser"/></parameter>',
        '<parameter name="Evil" value="a&#10;vehicle: b"/>',
    )
    code, text, err = run("convert", "process.xml", "-", "--to", "yaml")
    assert code == 0
    assert "geometry: geometry.xml # line 2: ModelServer/GeometryFile\n" in text
    assert "  rate_hz: 20.0 # line 3: ModelServer/PublishRateHz\n" in text
    left = text[text.index("# Not converted:") :].splitlines()[1:]
    assert all(line.startswith("#   line ") for line in left)
    for line, why in (
        (4, "no counterpart"),
        (5, "its name fits several keys"),
        (6, "publish.health_hz takes a number, got 'fast'"),
        (7, "state_hz is between 0 and 50, got 1000"),
        (8, "publish.rate_hz is given already (line 3)"),
        (9, "body Microstrain has no frame 'Senser'"),
        (10, "no counterpart"),
    ):
        (shown,) = [each for each in left if each.startswith(f"#   line {line}:")]
        assert why in shown
        assert f"process.xml:{line}: warning: " in err
        assert why in err
    assert "publish.mode or localization.mode" in err
    assert "so there will be no pose" in err
    (folder / "vehicle.yaml").write_text(text)
    config = load_config(folder / "vehicle.yaml")
    assert (config.publish.rate_hz, config.base_frame, config.vehicle) == (20.0, "Raptor:CG", "Raptor")


def test_given_sections_of_other_processes_then_their_parameters_are_not_taken_for_modelservers(
    folder: Path, run: Run
) -> None:
    (folder / "process.xml").write_text(
        """<config>
  <section name="Sokkia"><parameter name="RateHz" value="4"/><parameter name="StationaryTime" value="9"/></section>
  <section name="Common"><parameter name="GeometryFile" value="geometry.xml"/></section>
  <section name="ModelServer"><parameter name="RateHz" value="10"/></section>
  <section name="Gps">
    <parameter name="Channel" value="GPS"/><parameter name="Frame" value="GPSAntenna:PhaseCenter"/>
  </section>
</config>
"""
    )
    code, text, err = run("convert", "process.xml", "-", "--to", "yaml")
    assert code == 0
    assert "  rate_hz: 10.0 # line 4: ModelServer/RateHz\n" in text
    assert "    channel: GPS # line 6: Gps/Channel\n" in text
    assert "recapture_time" not in text
    assert [line for line in text.splitlines() if line.startswith("#   ")] == [
        "#   line 2: Sokkia/RateHz = '4': no counterpart",
        "#   line 2: Sokkia/StationaryTime = '9': no counterpart",
    ]
    assert err.count("warning") == 2


def test_given_another_folder_for_the_result_then_the_geometry_file_is_named_from_there(folder: Path, run: Run) -> None:
    (folder / "out").mkdir()
    assert run("convert", "process.xml", "out/vehicle.yaml")[0] == 0
    assert "geometry: ../geometry.xml " in (folder / "out/vehicle.yaml").read_text()
    assert load_config(folder / "out/vehicle.yaml").geometry == str(folder / "geometry.xml")


def test_given_no_known_name_then_the_one_parameter_that_names_a_file_is_the_geometry(folder: Path, run: Run) -> None:
    write(folder, '<parameter name="Model3D" value="geometry.xml"/>', '<parameter name="Log" value="not-there.xml"/>')
    code, out, err = run("convert", "process.xml", "vehicle.yaml")
    assert (code, out) == (0, "")
    assert "Model3D' is not" not in err
    assert load_config(folder / "vehicle.yaml").geometry == str(folder / "geometry.xml")


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        # the report's own example
        (
            ['<parameter name="Test"><parameter name="TestVector"><parameter value="2"/></parameter></parameter>'],
            ["no parameter names the geometry file", 'name="GeometryFile"'],
        ),
        (
            ['<parameter name="A1" value="geometry.xml"/>', '<parameter name="A2" value="process.xml"/>'],
            ["it may be one of ModelServer/A1, ModelServer/A2"],
        ),
        (
            ['<parameter name="GeometryFile" value="geometri.xml"/>'],
            ["process.xml:2: error: the geometry file 'geometri.xml' is missing", "did you mean geometry.xml?"],
        ),
        (['<parameter name="GeometryFile" value="wrong.xml"/>'], ["wrong.xml", "no geometry in this file"]),
        (["<parameter"], ["not well-formed"]),
    ],
)
def test_given_no_geometry_to_name_then_nothing_is_written_and_the_error_reports_what_to_do(
    folder: Path, run: Run, parameters: list[str], words: list[str]
) -> None:
    (folder / "wrong.xml").write_text("<config/>")
    write(folder, *parameters)
    code, out, err = run("convert", "process.xml", "vehicle.yaml")
    assert (code, out) == (1, "")
    assert all(each in err for each in words), err
    assert not (folder / "vehicle.yaml").exists()


def test_given_a_target_that_is_no_yaml_or_exists_then_nothing_is_written(folder: Path, run: Run) -> None:
    code, _, err = run("convert", "process.xml", "vehicle.urdf")
    assert code == 2
    assert "which becomes a vehicle file in YAML" in " ".join(err.split())
    (folder / "vehicle.yaml").write_text("mine")
    code, _, err = run("convert", "process.xml", "vehicle.yaml")
    assert code == 1
    assert "already exists" in err
    assert (folder / "vehicle.yaml").read_text() == "mine"


def test_given_very_many_parameters_then_the_file_is_refused(folder: Path, run: Run) -> None:
    write(folder, GEOMETRY, *['<parameter name="X" value="1"/>'] * 10_001)
    code, _, err = run("convert", "process.xml", "vehicle.yaml")
    assert code == 1
    assert "more than 10000 parameters" in err
