"""The vehicle file: every problem at once, each with its line, its key and what to do; no bytes hang or crash it."""

from __future__ import annotations

import random
import re
from contextlib import suppress
from pathlib import Path

import pytest
from support_samples import VEHICLE, write_vehicle

from modelserver.config.reader import MAX_BYTES
from modelserver.config.vehicle_file import (
    AidingConfig,
    CommandsConfig,
    GpsConfig,
    LocalizationConfig,
    VehicleConfig,
    WarmStartConfig,
    load_config,
    load_partly,
    parse_config,
)
from modelserver.errors import ConfigError, Problem, Severity
from modelserver.messages import Mode

ROOT = Path(__file__).resolve().parents[2]
BASE = "vehicle: v\ngeometry: g.yaml\nbase_frame: A:B\n"


def problems(text: str | bytes, base: str = BASE) -> tuple[Problem, ...]:
    raw = base.encode() + (text.encode() if isinstance(text, str) else text)
    with pytest.raises(ConfigError) as caught:
        parse_config(raw, "vehicle.yaml")
    found = caught.value.problems
    assert found
    assert all(each.severity is Severity.ERROR and each.file == "vehicle.yaml" and each.message for each in found)
    assert all(len(str(each)) < 600 for each in found)
    return found


def problem(text: str | bytes, base: str = BASE) -> Problem:
    (found,) = problems(text, base)
    return found


# --- what is good -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(ROOT.glob("config/*/vehicle.yaml")), ids=lambda path: path.parent.name)
def test_given_the_vehicle_files_of_this_project_then_they_load(path: Path) -> None:
    config = load_config(path)
    assert config.vehicle
    assert Path(config.geometry).is_file()


def test_given_the_three_keys_then_the_rest_has_defaults() -> None:
    config = parse_config(BASE.encode())
    assert config == VehicleConfig("v", "g.yaml", "A:B")
    assert (config.publish.mode, config.publish.rate_hz, config.limits.queued_requests) == ("timer", 50.0, 256)


def test_given_no_localization_then_all_sources_count_and_nobody_switches() -> None:
    config = parse_config((BASE + "sensors: {wheels: {channel: W}}\n").encode())
    assert config.localization == LocalizationConfig()
    assert (config.localization.initial_mode, config.localization.mode_channel) == (Mode.FULL, "")
    assert config.localization.magnetometer.soft_iron == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    assert (config.publish.state_hz, config.publish.decisions) == (5.0, True)
    assert config.sensors.wheels is not None
    assert (config.sensors.wheels.kinematics, config.sensors.wheels.latency) == ("differential", 0.0)


def test_given_a_warm_start_section_then_it_is_read_and_its_ranges_are_checked() -> None:
    assert parse_config(BASE.encode()).warm_start == WarmStartConfig(True, 5.0, 86400.0, 20.0)
    text = BASE + "warm_start: {persist: false, period_s: 0.5, max_age_s: 3600, max_pose_age_s: 0}\n"
    assert parse_config(text.encode()).warm_start == WarmStartConfig(False, 0.5, 3600.0, 0.0)
    for key, value in (("period_s", 0.1), ("max_age_s", -1), ("max_pose_age_s", 601)):
        with pytest.raises(ConfigError, match=f"{key} is between"):
            parse_config(f"{BASE}warm_start: {{{key}: {value}}}\n".encode())


@pytest.mark.parametrize("mode", Mode)
def test_given_any_mode_then_the_vehicle_file_knows_it(mode: Mode) -> None:
    text = f"{BASE}localization: {{mode: {mode.name.lower()}}}\n"
    assert parse_config(text.encode()).localization.initial_mode is mode


def test_given_every_key_then_each_is_taken() -> None:
    config = parse_config(
        (
            BASE
            + """\
variables: {MRN: K11}
lcm: {url: "memq://", channel_prefix: V1_, reply_prefix: ANSWER_}
publish: {mode: event, rate_hz: 10, health_hz: 2.5, state_hz: 0, decisions: false}
sensors:
  gps: {channel: gps/front, frame: A:G, second_frame: A:H, latency: 0.12}
  imu: {channel: IMU.1, frame: A:I, latency: 5}
  wheels: {channel: W, frames: {left: A:L}, kinematics: skid_steer, latency: 0.05}
  aiding:
    visual odometry: {channel: VO, type: relative_pose, latency: 0.1}
    map: {channel: MAP, type: absolute_pose}
origin: {initial_utm: [445000, 5030000.5, 71], zone: 18, hemisphere: south, persist: false}
localization:
  mode: dead_reckoning
  mode_channel: LOCALIZATION_MODE
  raw: {gps_timeout: 3}
  filter: {minimum_fix_type: 3}
  magnetometer: {hard_iron: [1e-6, -2e-6, 0], soft_iron: [1, 0, 0, 0, 2, 0, 0, 0, 1], declination_deg: -14.5}
limits: {history_s: 10, waiting_requests: 0, wait_ms: 0, queued_requests: 1, requests_per_pass: 1}
"""
        ).encode()
    )
    assert config.variables == {"MRN": "K11"}
    assert config.origin.initial_utm == (445000.0, 5030000.5, 71.0)
    assert config.sensors.wheels is not None
    assert config.sensors.wheels.frames == {"left": "A:L"}
    wheels, aiding = config.sensors.wheels, config.sensors.aiding
    assert (wheels.kinematics, wheels.latency) == ("skid_steer", 0.05)
    assert config.sensors.gps == GpsConfig("gps/front", "A:G", 0.12, second_frame="A:H")
    assert aiding == {
        "visual odometry": AidingConfig("VO", "relative_pose", 0.1),
        "map": AidingConfig("MAP", "absolute_pose"),
    }
    localization = config.localization
    assert (localization.initial_mode, localization.mode_channel) == (Mode.DEAD_RECKONING, "LOCALIZATION_MODE")
    assert (localization.raw.gps_timeout, localization.filter.minimum_fix_type) == (3.0, 3)
    assert localization.magnetometer.hard_iron == (1e-6, -2e-6, 0.0)
    assert localization.magnetometer.declination_deg == -14.5
    assert (config.publish.state_hz, config.publish.decisions) == (0.0, False)
    assert config.limits.waiting_requests == 0


def test_given_relative_paths_then_they_are_relative_to_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_vehicle(tmp_path)
    monkeypatch.chdir("/")
    config = load_config(path)
    assert config.geometry == str((tmp_path / "geometry.yaml").resolve())
    assert config.state_directory == str((tmp_path / "state").resolve())


def test_given_a_section_with_nothing_in_it_then_it_counts_as_left_out() -> None:
    assert parse_config((BASE + "publish:\n  # rate_hz: 10\nsensors:\n  gps:\n").encode()) == parse_config(
        BASE.encode()
    )


@pytest.mark.parametrize(("text", "value"), [("1e1", 10.0), ("+.5E+2", 50.0), ("5.e-1", 0.5), ("20", 20.0)])
def test_given_a_number_with_an_exponent_then_it_is_a_number(text: str, value: float) -> None:
    assert parse_config(f"{BASE}publish: {{rate_hz: {text}}}\n".encode()).publish.rate_hz == value


def test_given_a_byte_order_mark_or_crlf_then_it_is_read() -> None:
    assert parse_config(b"\xef\xbb\xbf" + BASE.replace("\n", "\r\n").encode()).vehicle == "v"


# --- what is missing or unknown -----------------------------------------------------------------------------


@pytest.mark.parametrize("missing", ["vehicle", "geometry", "base_frame"])
def test_given_a_missing_key_then_it_is_named(missing: str) -> None:
    base = "".join(line for line in BASE.splitlines(keepends=True) if not line.startswith(missing))
    found = problem("", base)
    assert (found.element, found.line) == (missing, 1)
    assert missing in found.message
    assert found.fix == f"add a line: {missing}: ..."


@pytest.mark.parametrize(
    ("text", "element", "line", "near"),
    [
        ("jornal: {}\n", "jornal", 4, "journal"),
        ("lcm:\n  ulr: x\n", "lcm.ulr", 5, "url"),
        ("publish:\n  mode: timer\n  rate: 5\n", "publish.rate", 6, "rate_hz"),
        ("sensors:\n  gsp: {channel: GPS, frame: A:B}\n", "sensors.gsp", 5, "gps"),
        ("sensors:\n  gps:\n    channel: G\n    frame: A:B\n    latnecy: 0\n", "sensors.gps.latnecy", 8, "latency"),
        ("sensors:\n  wheels:\n    chanel: W\n", "sensors.wheels.chanel", 6, "channel"),
        (
            "sensors:\n  gps:\n    channel: G\n    frame: A:B\n    second_fram: A:C\n",
            "sensors.gps.second_fram",
            8,
            "second_frame",
        ),
        ("origin:\n  presist: true\n", "origin.presist", 5, "persist"),
        ("localization:\n  raw:\n    gps_timeot: 3\n", "localization.raw.gps_timeot", 6, "gps_timeout"),
        ("localization:\n  mode_chanel: M\n", "localization.mode_chanel", 5, "mode_channel"),
        (
            "sensors:\n  aiding:\n    vo: {channel: V, type: range, latncy: 0}\n",
            "sensors.aiding.vo.latncy",
            6,
            "latency",
        ),
        ("sensors:\n  wheels:\n    kinematic: ackermann\n", "sensors.wheels.kinematic", 6, "kinematics"),
        ("limits:\n  wait: 3\n", "limits.wait", 5, "wait_ms"),
    ],
)
def test_given_an_unknown_key_at_any_level_then_line_key_and_nearest_are_named(
    text: str, element: str, line: int, near: str
) -> None:
    found = problem(text)
    assert (found.element, found.line) == (element, line)
    assert found.nearest[0] == near
    assert found.fix == f"write {near}"
    assert "unknown key" in found.message


@pytest.mark.parametrize(
    ("text", "key", "near", "fix"),
    [
        # raw mode's settings as the files of earlier versions have them
        ("minimum_fix_type: 1", "minimum_fix_type", "minimum_fix_type",
         "write minimum_fix_type under localization.raw or localization.filter"),
        ("speed_window: 1", "speed_window", "speed_window", "write speed_window under localization.raw"),
        ("speed_windw: 1", "speed_windw", "speed_window", "write speed_window under localization.raw"),
        ("hard_iron: [0, 0, 0]", "hard_iron", "hard_iron", "write hard_iron under localization.magnetometer"),
    ],
)  # fmt: skip
def test_given_a_key_that_stands_one_level_deeper_then_where_is_named(text: str, key: str, near: str, fix: str) -> None:
    found = problem(f"localization:\n  {text}\n")
    assert (found.element, found.line, found.nearest[0]) == (f"localization.{key}", 5, near)
    assert found.fix.startswith(fix)
    assert f"unknown key '{key}'" in found.message


def test_given_a_misspelled_section_then_the_keys_in_it_are_examined_under_its_name() -> None:
    found = problems("warm_strat: {persits: false, period_s: 0}\n")
    assert [each.element for each in found] == ["warm_strat", "warm_start.persits", "warm_start.period_s"]


def test_given_an_unknown_key_like_one_that_is_given_already_then_that_is_not_proposed() -> None:
    found = problem("geometri: x\n")
    assert (found.element, found.nearest, found.edit) == ("geometri", (), None)


def test_given_a_key_of_a_section_at_the_top_then_the_section_is_named() -> None:
    assert problem("rate_hz: 10\n").fix == "write rate_hz under publish"


def test_given_an_unknown_key_like_no_other_then_the_known_ones_are_named() -> None:
    assert (
        problem("publish: {zzzzzz: 1}\n").fix == "known here: mode, rate_hz, health_hz, state_hz, decisions, snapshot_s"
    )


def test_given_many_problems_then_all_are_reported_at_once() -> None:
    found = problems("vehicl: x\npublish: {mode: often, rate_hz: 0}\nlimits: {wait_ms: x}\nsensors: {gps: {}}\n")
    assert [each.element for each in found] == [
        "vehicl",
        "publish.mode",
        "publish.rate_hz",  # which is looked at though the mode is none
        "limits.wait_ms",
        "sensors.gps.channel",
        "sensors.gps.frame",
    ]
    assert len({each.line for each in found}) == 4


@pytest.mark.parametrize(
    ("text", "element", "line", "first"),
    [
        ("vehicle: w\n", "vehicle", 4, 1),
        ("publish:\n  rate_hz: 5\n  rate_hz: 6\n", "publish.rate_hz", 6, 5),
        ("sensors:\n  gps: {channel: A, channel: B, frame: A:B}\n", "sensors.gps.channel", 5, 5),
    ],
)
def test_given_a_key_twice_then_both_lines_are_named(text: str, element: str, line: int, first: int) -> None:
    found = problem(text)
    assert (found.element, found.line) == (element, line)
    assert f"given twice (first on line {first})" in found.message


# --- what is wrong with a value -----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "element", "message"),
    [
        ("publish:\n  rate_hz: .nan", "publish.rate_hz", "finite"),
        ("publish:\n  rate_hz: -.inf", "publish.rate_hz", "finite"),
        ("publish:\n  rate_hz: 1e999", "publish.rate_hz", "number|finite"),
        ("publish:\n  rate_hz: '50'", "publish.rate_hz", "number"),
        ("publish:\n  rate_hz: true", "publish.rate_hz", "number"),
        ("publish:\n  rate_hz: [50]", "publish.rate_hz", "number"),
        ("publish:\n  rate_hz: 0.05", "publish.rate_hz", "between 0.1 and 1000, got 0.05"),
        ("publish:\n  rate_hz: 100000", "publish.rate_hz", "between 0.1 and 1000, got 100000"),
        ("publish:\n  health_hz: 0", "publish.health_hz", "between 0.01 and 100, got 0"),
        ("publish:\n  mode: Timer", "publish.mode", "'timer' or 'event', got 'Timer'"),
        ("limits:\n  wait_ms: 3.5", "limits.wait_ms", "integer"),
        ("limits:\n  wait_ms: -1", "limits.wait_ms", "between 0 and 60000, got -1"),
        ("limits:\n  queued_requests: 0", "limits.queued_requests", "between 1 and 65536"),
        ("limits:\n  history_s: 0", "limits.history_s", "above 0"),
        (f"limits:\n  wait_ms: {'9' * 5000}", "limits.wait_ms", "integer"),
        (f"limits:\n  wait_ms: {'9' * 4000}", "limits.wait_ms", "integer|between"),
        (f"limits:\n  history_s: {'9' * 400}", "limits.history_s", "number|finite"),
        ("journal:\n  megabytes: 31", "journal.megabytes", "0 for no journal, or 32 to 1000000, got 31"),
        ("journal:\n  megabytes: -1", "journal.megabytes", "got -1"),
        ("journal:\n  sync_s: 0.1", "journal.sync_s", "between 0.2 and 60 seconds, got 0.1"),
        ("journal:\n  directory: 3", "journal.directory", "string"),
        ("origin:\n  persist: 'yes'", "origin.persist", "boolean"),
        ("origin:\n  zone: 61", "origin", "given together"),
        ("origin:\n  initial_utm: [1, 2]", "origin.initial_utm", "too few numbers"),
        ("origin:\n  initial_utm: [1, 2, north]", "origin.initial_utm.2", "number"),
        ("variables:\n  MRN: 11", "variables.MRN", "string"),
        ("variables: MRN", "variables", "mapping|object"),
        ("publish: 50", "publish", "expected a mapping"),
        ("publish: [50]", "publish", "expected a mapping"),
        ("lcm:\n  reply_prefix: ''", "lcm.reply_prefix", "must not be empty"),
        ("lcm:\n  reply_prefix: 'A B'", "lcm.reply_prefix", "letters, digits and underscores"),
        ("lcm:\n  channel_prefix: Ä", "lcm.channel_prefix", "letters, digits and underscores"),
        (f"lcm:\n  channel_prefix: {'A' * 25}", "lcm.channel_prefix", "at most 24"),
        ("lcm:\n  channel_prefix: 'A.*'", "lcm.channel_prefix", "letters, digits and underscores"),
        ("publish:\n  state_hz: -1", "publish.state_hz", "between 0 and 50, got -1"),
        ("publish:\n  state_hz: 51", "publish.state_hz", "between 0 and 50, got 51"),
        ("publish:\n  decisions: 1", "publish.decisions", "boolean"),
        ("localization:\n  raw: {gps_timeout: -1}", "localization.raw.gps_timeout", "above 0"),
        ("localization:\n  raw: {risk: 0.9}", "localization.raw.risk", "at most 0.5"),
        ("localization:\n  filter: {uere: -1}", "localization.filter.uere", "above 0"),
        ("localization:\n  mode: Full", "localization.mode", "'full', 'raw'.*got 'Full'"),
        ("localization:\n  mode_channel: 'A B'", "localization.mode_channel", "mode_channel has 1 to 39"),
        ("limits:\n  client_hz: 0.5", "limits.client_hz", "between 1 and 100000, got 0.5"),
        ("limits:\n  request_share: 1.5", "limits.request_share", "between 0 and 1, got 1.5"),
        ("sensors:\n  publisher_conflict: both", "sensors.publisher_conflict", "'ignore' or 'use'.*got 'both'"),
        ("commands:\n  window_s: 0.01", "commands.window_s", "between 0.1 and 300"),
        ("commands:\n  reload: true", "commands.reload", "key_file.*modelserver key new"),
        ("commands:\n  set_pose: true", "commands.set_pose", "key_file.*modelserver key new"),
        ("localization:\n  magnetometer: {hard_iron: [1, 2]}", "localization.magnetometer.hard_iron", "too few"),
        ("localization:\n  magnetometer: {declination_deg: 181}", "localization.magnetometer.declination_deg", "-180"),
        ("localization:\n  magnetometer: {soft_iron: [0, 0, 0, 0, 0, 0, 0, 0, 0]}",
         "localization.magnetometer.soft_iron", "no positive determinant"),
        ("sensors:\n  gps: {channel: G, frame: A:B, latency: -0.1}", "sensors.gps.latency", "between 0 and 5"),
        ("sensors:\n  imu: {channel: G, frame: A:B, latency: 5.1}", "sensors.imu.latency", "between 0 and 5"),
        ("sensors:\n  wheels: {latency: .nan}", "sensors.wheels.latency", "finite"),
        ("sensors:\n  wheels: {kinematics: tank}", "sensors.wheels.kinematics", "'skid_steer'.*got 'tank'"),
        ("sensors:\n  aiding: {vo: {channel: V, type: range, latency: 9}}", "sensors.aiding.vo.latency", "0 and 5"),
        ("sensors:\n  aiding: {vo: {type: range}}", "sensors.aiding.vo.channel", "missing"),
        (f"sensors:\n  aiding: {{{'v' * 65}: {{channel: V, type: range}}}}", "sensors.aiding", "1 to 64"),
    ],
)  # fmt: skip
def test_given_a_value_that_cannot_be_then_line_key_and_why_are_named(text: str, element: str, message: str) -> None:
    found = problems(text + "\n")[0]
    assert found.element == element
    assert found.line == (5 if "\n" in text and element != "origin" else 4)
    assert re.search(message, found.message)
    assert len(found.message) < 300


def test_given_a_key_file_then_its_path_starts_from_the_vehicle_file(tmp_path: Path) -> None:
    path, text = tmp_path / "vehicle.yaml", "vehicle: v\ngeometry: g.yaml\nbase_frame: A:B\n"
    path.write_text(f"{text}commands: {{reload: true, key_file: keys/commands.key}}\n")
    assert load_config(path).commands.key_file == str(tmp_path / "keys" / "commands.key")
    path.write_text(text)
    assert load_config(path).commands == CommandsConfig()


def test_given_a_zone_that_is_none_then_it_is_rejected() -> None:
    found = problem("origin: {initial_utm: [445000, 5030000, 0], zone: 61, hemisphere: north}\n")
    assert "1 to 60, got 61" in found.message


@pytest.mark.parametrize("channel", ["''", "'A B'", "Ä", "A" * 40, '"A\\nB"', '"\\x00"'])
@pytest.mark.parametrize("sensor", ["gps", "imu", "wheels"])
def test_given_a_channel_that_lcm_cannot_carry_then_it_is_rejected(sensor: str, channel: str) -> None:
    frame = "" if sensor == "wheels" else ", frame: A:B"
    found = problem(f"sensors:\n  {sensor}: {{channel: {channel}{frame}}}\n")
    assert (found.element, found.line) == (f"sensors.{sensor}.channel", 5)
    assert "printable ASCII" in found.message


@pytest.mark.parametrize("other", ["imu: {channel: X, frame: A:C}", "aiding: {vo: {channel: X, type: relative_pose}}"])
def test_given_two_sensors_on_one_channel_then_it_is_rejected(other: str) -> None:
    found = problem(f"sensors:\n  gps: {{channel: X, frame: A:B}}\n  {other}\n")
    assert "'X' is given twice" in found.message


# --- what is no vehicle file at all -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "empty"),
        (b"\n\n# nothing\n", "empty"),
        (b"- a\n- b\n", "not a mapping"),
        (b"just words\n", "not a mapping"),
        (b"a: 1\n---\nb: 2\n", "another document"),
        (b"\ta: 1\n", "not YAML"),
        (b"a: [1\nb: 2\n", "not YAML"),
        (b"a: \x00\n", "not YAML"),
        (b"a: 1\nb: \xff\xfe\n", "not text in UTF-8: byte 0xff in this line"),
        (b"\x7fELF\x02\x01\x01" + bytes(200), "not YAML"),
        (b"<?xml version='1.0'?><a/>", "not a mapping|not YAML"),
        (b"? [a, b]\n: c\n", "a key is a name"),
        (b"? {a: b}\n: c\n", "a key is a name"),
        (b"a: &x 1\nb: *x\n", "aliases"),
        (b"a: *nowhere\n", "alias"),
        (b"a: &x [*x]\n", "aliases"),
        (b"a: " + b"[" * 100_000, "nested too deeply"),
        (b"a: " + b"{a: " * 100_000, "nested too deeply"),
        (b"\n".join(b" " * n + b"a:" for n in range(300)), "nested too deeply"),
        (b"a: " + b"x" * MAX_BYTES, "larger than 1 MiB"),
    ],
)
def test_given_bytes_that_are_no_vehicle_file_then_one_clear_problem(text: bytes, message: str) -> None:
    assert re.search(message, problem(text, "").message)


@pytest.mark.parametrize(
    ("name", "content", "message", "fix"),
    [
        (
            "geometry.yaml",
            b"bodies:\n  Cart: {}\n",
            "this is a geometry file, not a vehicle file",
            "geometry: geometry.yaml",
        ),
        ("g.yaml", b"modelserver: geometry/1\nname: x\n", "this is a geometry file, not", "takes it with --model"),
        (
            "r.urdf",
            b"<?xml version='1.0'?>\n<robot name='r'/>",
            "this is a URDF, a geometry file format",
            "geometry: r.urdf",
        ),
        ("m.xml", b"<config><section/></config>", "this is XML, not a vehicle file", "takes it with --model"),
        (
            "process.xml",
            b'<config><section name="ModelServer"><parameter name="UpdateRateHz" value="10"/></section></config>',
            "this is a process file of the original ModelServer (2005), not a vehicle file",
            "publish.rate_hz",
        ),
        ("drive.lcm", b"\xed\xa1\xda\x01" + bytes(40), "this is an LCM event log, not", "modelserver replay"),
        ("photo.png", b"\x89PNG\r\n\x1a\n\0\0\0", "this is not text, not a vehicle file", "which is YAML"),
        ("empty.yaml", b"", "the file is empty", "start with: vehicle, geometry, base_frame"),
        ("notes.yaml", b"# vehicle: x\n\n  # y\n", "nothing in the file but comments", "start with: vehicle"),
    ],
)
def test_given_a_file_of_another_kind_then_one_error_names_its_type_and_use(
    tmp_path: Path, name: str, content: bytes, message: str, fix: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    for load in (load_config, load_partly):
        with pytest.raises(ConfigError) as raised:
            load(path)
        (found,) = raised.value.problems
        assert found.message.startswith(message) or message in found.message
        assert fix in found.fix
        assert found.file == str(path)


def test_given_a_directory_then_the_vehicle_file_in_it_is_named(tmp_path: Path) -> None:
    def fix() -> str:
        with pytest.raises(ConfigError, match="this is a directory, not a vehicle file") as raised:
            load_config(tmp_path)
        return raised.value.problems[0].fix

    assert fix() == "give the vehicle file itself"
    (tmp_path / "vehicle.yaml").touch()
    assert fix() == f"give {tmp_path / 'vehicle.yaml'}"


def test_given_aliases_of_aliases_then_they_are_rejected_before_they_are_written_out() -> None:
    levels = "".join(f"k{n}: &k{n} [{', '.join([f'*k{n - 1}'] * 10)}]\n" for n in range(1, 15))
    assert "aliases" in problem(f"k0: &k0 [x]\n{levels}").message


def test_given_a_python_tag_then_nothing_is_built_from_it(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    found = problems(f'vehicle: !!python/object/apply:os.system ["touch {trace}"]\n', "")
    assert found
    assert not trace.exists()


@pytest.mark.slow
def test_given_damage_anywhere_then_nothing_but_config_error_is_raised() -> None:
    rng = random.Random(3)
    whole = (ROOT / "config" / "raptor" / "vehicle.yaml").read_bytes()
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(rng.choice((1, 3, 30))):
            damaged[rng.randrange(len(damaged))] = rng.choice((0, 9, 10, 32, 34, 38, 42, 45, 58, 91, 123, 255, 65))
        with suppress(ConfigError):
            parse_config(bytes(damaged[: rng.randrange(len(damaged)) or None]), "x")


def test_given_a_file_that_is_not_there_then_it_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_config(tmp_path / "none.yaml")


def test_given_the_cart_of_these_tests_then_it_loads(tmp_path: Path) -> None:
    assert load_config(write_vehicle(tmp_path, VEHICLE)).base_frame == "Cart:Base"
