"""The vehicle file against its geometry: all problems are found before the start."""

from __future__ import annotations

from pathlib import Path

import pytest
from support_samples import GEOMETRY, ORIGIN, VEHICLE, instant_at, write_vehicle
from support_samples import START as START_UTIME

from modelserver import core
from modelserver.config.vehicle_file import load_config
from modelserver.errors import ConfigError, GeometryError, Problem
from modelserver.estimation.filter.localizer import FilterLocalizer
from modelserver.estimation.modes import ModeLocalizer
from modelserver.estimation.raw.localizer import RawLocalizer
from modelserver.messages import (
    GpsSample,
    ImuSample,
    JointsSample,
    Mode,
    PublishHealth,
    RelativePoseSample,
    SensorHeader,
    SwitchMode,
    Tick,
)
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.daemon import log_mode_switch
from modelserver.server.ingress import SensorChannel
from modelserver.server.loop import Hooks, Loop, LoopSettings
from modelserver.server.vehicle import Vehicle, get_configured_origin, load_vehicle
from modelserver.wire.codec import encode

ROOT = Path(__file__).resolve().parents[3]


def vehicle(folder: Path, text: str = VEHICLE, geometry: str = GEOMETRY) -> Vehicle:
    return load_vehicle(load_config(write_vehicle(folder, text, geometry)))


def problems(folder: Path, text: str, geometry: str = GEOMETRY) -> tuple[Problem, ...]:
    with pytest.raises(ConfigError) as caught:
        vehicle(folder, text, geometry)
    return caught.value.problems


@pytest.mark.parametrize("path", sorted(ROOT.glob("config/*/vehicle.yaml")), ids=lambda path: path.parent.name)
def test_given_the_vehicles_of_this_project_then_they_load_whole(path: Path) -> None:
    loaded = load_vehicle(load_config(path))
    assert loaded.mounts is not None
    channels = {"GPS": SensorChannel("gps_t"), "IMU": SensorChannel("imu_t"), "WHEELS": SensorChannel("wheels_t")}
    if loaded.config.sensors.wheels and loaded.config.sensors.wheels.steering:
        channels["VEHICLE_STATUS"] = SensorChannel("vehicle_status_t")
    if loaded.model.joints:
        channels["JOINTS"] = SensorChannel("joints_t")
    if loaded.config.localization.mode_channel:
        channels["LOCALIZATION_MODE"] = SensorChannel("localization_mode_t")
    assert loaded.sensor_channels() == channels
    assert (loaded.tick_hz(), loaded.ticks_per_pose(), loaded.ticks_per_state()) == (50.0, 1, 10)


KEY = "commands: {key_file: commands.key}\n"

AIDING = """\
  aiding:
    vo: {channel: VO, type: relative_pose, latency: 0.08}
    mocap: {channel: ABSOLUTE_POSE, type: absolute_pose}
    uwb: {channel: RANGE, type: range}
"""


@pytest.mark.parametrize("prefix", ["", "V1_"])
def test_given_aiding_sources_and_a_mode_channel_then_they_are_subscribed(tmp_path: Path, prefix: str) -> None:
    text = VEHICLE.replace("frame: Cart:Antenna", "frame: Cart:Antenna, latency: 0.12") + AIDING
    text += f"{KEY}localization: {{mode_channel: LOCALIZATION_MODE}}\nlcm: {{channel_prefix: '{prefix}'}}\n"
    assert vehicle(tmp_path, text).sensor_channels() == {
        f"{prefix}GPS": SensorChannel("gps_t", 120_000),
        f"{prefix}IMU": SensorChannel("imu_t"),
        f"{prefix}VO": SensorChannel("relative_pose_t", 80_000),
        f"{prefix}ABSOLUTE_POSE": SensorChannel("absolute_pose_t"),
        f"{prefix}RANGE": SensorChannel("range_t"),
        f"{prefix}LOCALIZATION_MODE": SensorChannel("localization_mode_t"),
    }


@pytest.mark.parametrize(
    ("given", "fix"),
    [
        ("relative_pos", "write relative_pose"),
        ("sonar", "install the package that defines it (entry point group modelserver.measurements), or write one of "),
    ],
)
def test_given_an_unknown_type_of_aiding_then_the_fix_names_what_is_known(tmp_path: Path, given: str, fix: str) -> None:
    (found,) = problems(tmp_path, f"{VEHICLE}{AIDING}".replace("type: relative_pose", f"type: {given}"))
    assert (found.element, found.message) == ("sensors.aiding.vo.type", f"unknown type '{given}'")
    assert found.fix.startswith(fix)


@pytest.mark.parametrize("channel", ["GPS", "VO", "POSE", "LOCALIZATION_STATE", "POSE_GET_HISTORY", "VEHICLE_COMMAND"])
def test_given_a_mode_channel_with_another_use_then_it_is_rejected(tmp_path: Path, channel: str) -> None:
    (found,) = problems(tmp_path, f"{VEHICLE}{AIDING}{KEY}localization: {{mode_channel: {channel}}}\n")
    assert (found.element, found.fix) == ("localization.mode_channel", "write LOCALIZATION_MODE")
    assert channel in found.message


@pytest.mark.parametrize("channel", ["LOCALIZATION_MODE", "MODE", "console/mode"])
def test_given_a_mode_channel_of_its_own_then_it_is_accepted(tmp_path: Path, channel: str) -> None:
    text = f"{VEHICLE}{KEY}localization: {{mode_channel: {channel}}}\n"
    assert vehicle(tmp_path, text).sensor_channels()[channel] == SensorChannel("localization_mode_t")


def test_given_a_mode_channel_without_a_key_then_it_is_rejected_with_how_to_make_one(tmp_path: Path) -> None:
    (found,) = problems(tmp_path, VEHICLE + "localization: {mode_channel: LOCALIZATION_MODE}\n")
    assert found.element == "localization.mode_channel"
    assert "modelserver key new" in found.message


@pytest.mark.parametrize("channel", ["POSE", "LOCALIZATION_DECISIONS", "LOCALIZATION_MODE"])
def test_given_an_aiding_source_on_a_channel_of_the_server_then_it_is_rejected(tmp_path: Path, channel: str) -> None:
    (found,) = problems(tmp_path, VEHICLE + AIDING.replace("channel: VO", f"channel: {channel}"))
    assert found.element == "sensors.aiding.vo.channel"


def test_given_a_mode_channel_that_replies_may_use_then_it_is_rejected(tmp_path: Path) -> None:
    (found,) = problems(tmp_path, VEHICLE + KEY + "localization: {mode_channel: REPLY_MODE}\n")
    assert found.element == "lcm.reply_prefix"


@pytest.mark.parametrize(
    ("publish", "ticks"),
    [("state_hz: 0", 0), ("state_hz: 50", 1), ("state_hz: 10", 5), ("state_hz: 0.5", 100),
     ("state_hz: 50, rate_hz: 200", 4), ("mode: event, state_hz: 5", 10)],
)  # fmt: skip
def test_given_a_rate_of_states_then_it_is_counted_in_ticks(tmp_path: Path, publish: str, ticks: int) -> None:
    loaded = vehicle(tmp_path, f"{VEHICLE}publish: {{{publish}, decisions: false}}\n")
    settings = loaded.start_core(instant_at(START_UTIME)).settings
    assert (loaded.ticks_per_state(), settings.ticks_per_state, settings.publish_decisions) == (ticks, ticks, False)


def test_given_a_vehicle_then_its_core_starts_with_the_settings_of_its_file(tmp_path: Path) -> None:
    text = VEHICLE + "publish: {mode: event, health_hz: 4}\nlimits: {history_s: 7, wait_ms: 5, waiting_requests: 6}\n"
    state = vehicle(tmp_path, text + "lcm: {reply_prefix: ANSWER_, channel_prefix: V1_}\n").start_core(
        instant_at(START_UTIME)
    )
    settings = state.settings
    assert (settings.base_frame, settings.vehicle, settings.publish) == ("Cart:Base", "cart", "event")
    assert (settings.health_period_ns, settings.history_s, settings.wait_ms) == (250_000_000, 7.0, 5)
    assert (settings.waiting_requests, settings.reply_prefix) == (6, "ANSWER_")
    assert isinstance(state.view.localizer, ModeLocalizer)
    assert isinstance(state.view.localizer.active, FilterLocalizer)


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.RAW])
def test_given_a_mode_of_the_filter_then_the_filter_starts_in_it(tmp_path: Path, mode: Mode) -> None:
    text = f"{VEHICLE}localization: {{mode: {mode.name.lower()}}}\n"
    localizer = vehicle(tmp_path, text).start_core(instant_at(START_UTIME)).view.localizer
    assert isinstance(localizer, ModeLocalizer)
    assert isinstance(localizer.active, FilterLocalizer)
    assert localizer.active.mode is mode


def test_given_raw_mode_then_raw_mode_starts(tmp_path: Path) -> None:
    localizer = (
        vehicle(tmp_path, f"{VEHICLE}localization: {{mode: raw}}\n").start_core(instant_at(START_UTIME)).view.localizer
    )
    assert isinstance(localizer, ModeLocalizer)
    assert isinstance(localizer.active, RawLocalizer)


def test_given_a_second_antenna_then_its_frame_is_checked_and_known(tmp_path: Path) -> None:
    given = "frame: Cart:Antenna, second_frame: Cart:Mast"
    rig = vehicle(tmp_path, VEHICLE.replace("frame: Cart:Antenna", given)).rig
    assert rig is not None
    assert rig.second_antenna_frame == "Cart:Mast"
    (found,) = problems(tmp_path, VEHICLE.replace("frame: Cart:Antenna", given.replace("Mast", "Masd")))
    assert (found.element, found.fix) == ("sensors.gps.second_frame", "write Cart:Mast")


@pytest.mark.parametrize(
    ("old", "new", "key", "near"),
    [
        ("frame: Cart:Antenna", "frame: Cart:Antena", "sensors.gps.frame", "Cart:Antenna"),
        ("frame: Cart:Imu", "frame: Crat:Imu", "sensors.imu.frame", "Cart:Imu"),
        ("base_frame: Cart:Base", "base_frame: Cart:Bsae", "base_frame", "Cart:Base"),
    ],
)
def test_given_an_unknown_frame_then_key_and_nearest_are_reported(
    tmp_path: Path, old: str, new: str, key: str, near: str
) -> None:
    found = problems(tmp_path, VEHICLE.replace(old, new))
    assert found[0].element == key
    assert near in found[0].nearest
    assert found[0].fix == f"write {near}"


def test_given_wheels_with_unknown_frames_then_each_is_reported(tmp_path: Path) -> None:
    text = VEHICLE + "  wheels: {channel: W, frames: {left: Cart:Mast, right: Cart:Msat, rear: Cart}}\n"
    found = problems(tmp_path, text)
    assert [each.element for each in found] == ["sensors.wheels.frames.right", "sensors.wheels.frames.rear"]


def test_given_a_base_frame_that_is_not_connected_to_the_sensors_then_it_is_rejected(tmp_path: Path) -> None:
    geometry = GEOMETRY.replace("constraints:", "  Lamp:\n    frames:\n      Origin:\nconstraints:")
    found = problems(tmp_path, VEHICLE.replace("base_frame: Cart:Base", "base_frame: Lamp:Origin"), geometry)
    assert [each.element for each in found] == ["sensors.gps.frame", "sensors.imu.frame"]
    assert all("no constraints lead" in each.message for each in found)


def test_given_a_world_frame_as_base_frame_then_it_is_rejected(tmp_path: Path) -> None:
    assert problems(tmp_path, VEHICLE.replace("base_frame: Cart:Base", "base_frame: World:UTM"))


def test_given_an_invalid_geometry_then_its_problems_are_reported(tmp_path: Path) -> None:
    with pytest.raises(GeometryError, match="Camrea"):
        vehicle(tmp_path, geometry=GEOMETRY.replace("to: Camera:Origin", "to: Camrea:Origin"))
    with pytest.raises(ConfigError, match=r"geometry file .*geometri.yaml cannot be read: No such file"):
        vehicle(tmp_path, VEHICLE.replace("geometry.yaml", "geometri.yaml"))


@pytest.mark.parametrize(
    "text",
    [
        "lcm: {reply_prefix: POS}\n",
        "lcm: {reply_prefix: G}\n",
        "lcm: {reply_prefix: MODELSERVER_HEALTH}\n",
        "lcm: {reply_prefix: V1_, channel_prefix: V1_}\n",
        "lcm: {reply_prefix: V1_PO, channel_prefix: V1_}\n",
    ],
)
def test_given_a_reply_prefix_that_other_channels_have_then_it_is_rejected(tmp_path: Path, text: str) -> None:
    (found,) = problems(tmp_path, VEHICLE + text)
    assert found.element == "lcm.reply_prefix"
    assert "could make the server reply on" in found.message


@pytest.mark.parametrize("channel", ["POSE", "MODELSERVER_HEALTH", "PLATFORM_GET_BODY_LIST", "VEHICLE_COMMAND"])
@pytest.mark.parametrize("prefix", ["", "lcm: {channel_prefix: V1_}\n"])
def test_given_a_sensor_on_a_channel_of_the_server_then_it_is_rejected(
    tmp_path: Path, channel: str, prefix: str
) -> None:
    (found,) = problems(tmp_path, VEHICLE.replace("channel: GPS", f"channel: {channel}") + prefix)
    assert found.element == "sensors.gps.channel"
    assert channel in found.message


def test_given_a_configured_origin_then_it_has_precedence_over_a_persisted_one(tmp_path: Path) -> None:
    text = VEHICLE + "origin: {initial_utm: [445000, 5030000, 71], zone: 18, hemisphere: north}\n"
    loaded = vehicle(tmp_path, text)
    configured = get_configured_origin(loaded.config)
    assert configured is not None
    assert configured.initial_utm == (445000.0, 5030000.0, 71.0)
    localizer = loaded.start_core(instant_at(START_UTIME), ORIGIN).view.localizer
    assert localizer is not None
    assert localizer.estimate(START_UTIME).origin == configured
    restored = vehicle(tmp_path).start_core(instant_at(START_UTIME), ORIGIN).view.localizer
    assert restored is not None
    assert restored.estimate(START_UTIME).origin == ORIGIN


@pytest.mark.parametrize("numbers", ["9e6, 5030000, 71", "445000, -1, 71", "445000, 2e7, 71"])
def test_given_a_configured_origin_outside_its_zone_then_it_is_rejected(tmp_path: Path, numbers: str) -> None:
    numbers = numbers.replace("9e6", "9000000.0").replace("2e7", "20000000.0")
    (found,) = problems(tmp_path, VEHICLE + f"origin: {{initial_utm: [{numbers}], zone: 18, hemisphere: north}}\n")
    assert found.element == "origin.initial_utm"


@pytest.mark.parametrize(
    ("rate", "ticks", "tick_hz"), [(50, 1, 50), (200, 1, 200), (30, 2, 60), (10, 5, 50), (1, 50, 50), (0.1, 500, 50)]
)
def test_given_a_pose_rate_then_ticks_are_never_rarer_than_housekeeping_needs(
    tmp_path: Path, rate: float, ticks: int, tick_hz: float
) -> None:
    loaded = vehicle(tmp_path, VEHICLE + f"publish: {{rate_hz: {rate}}}\n")
    assert (loaded.ticks_per_pose(), loaded.tick_hz()) == (ticks, pytest.approx(tick_hz))


def test_given_event_mode_then_ticks_are_for_housekeeping_alone(tmp_path: Path) -> None:
    loaded = vehicle(tmp_path, VEHICLE + "publish: {mode: event, rate_hz: 5}\n")
    assert (loaded.ticks_per_pose(), loaded.tick_hz()) == (1, 50.0)


def test_given_the_sensors_of_a_vehicle_file_then_the_core_knows_what_to_expect_and_where(tmp_path: Path) -> None:
    text = VEHICLE.replace("sensors:\n", "sensors:\n  aiding: {vo: {channel: VO, type: relative_pose}}\n")
    loaded = vehicle(tmp_path, text + "lcm: {channel_prefix: V1_}\n")
    expected = {(each.channel, each.kind, each.source) for each in loaded.expected_sensors()}
    assert expected == {
        ("V1_GPS", GpsSample, ""),
        ("V1_IMU", ImuSample, ""),
        ("V1_JOINTS", JointsSample, ""),
        ("V1_VO", RelativePoseSample, "vo"),
    }
    state = loaded.start_core(instant_at(START_UTIME))
    # the cart has no joints
    _, outputs = core.step(state, Tick(), instant_at(START_UTIME))
    health = next(each.health for each in outputs if isinstance(each, PublishHealth))
    assert [each.channel for each in health.channels] == ["V1_GPS", "V1_IMU", "V1_VO"]


def without(*left_out: str) -> str:
    return "".join(line for line in VEHICLE.splitlines(keepends=True) if not line.strip().startswith(left_out))


@pytest.mark.parametrize("left_out", ["gps:", "imu:"])
def test_given_one_of_the_two_sensors_then_the_filter_works_with_it_and_raw_mode_is_rejected(
    tmp_path: Path, left_out: str
) -> None:
    loaded = vehicle(tmp_path, without(left_out))
    assert loaded.mounts is None
    assert isinstance(loaded.start_core(instant_at(START_UTIME)).view.localizer, ModeLocalizer)
    (found,) = problems(tmp_path, without(left_out) + "localization: {mode: raw}\n")
    assert (found.element, found.fix) == ("localization.mode", "write mode: full")


def test_given_no_sensor_then_there_is_no_localizer(tmp_path: Path) -> None:
    loaded = vehicle(tmp_path, without("sensors:", "gps:", "imu:"))
    assert (loaded.rig, loaded.mounts) == (None, None)
    assert loaded.start_core(instant_at(START_UTIME)).view.localizer is None


def test_given_a_mode_command_then_the_switch_is_logged_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    text = VEHICLE + KEY + "localization: {mode_channel: M}\n"
    loaded = vehicle(tmp_path, text)
    clock = FakeClock(START_UTIME)
    bus = FakeBus(clock)
    loop = Loop(
        bus,
        clock,
        loaded.start_core(clock.now()),
        LoopSettings(20_000_000, loaded.sensor_channels()),
        Hooks(on_mode_switch=log_mode_switch),
    )
    for number, wanted in enumerate((Mode.RAW, Mode.RAW, Mode.NO_GPS)):
        header = SensorHeader(START_UTIME + number, "operator", number, START_UTIME + number)
        bus.sensors.put("M", encode(SwitchMode(header, wanted)))
        loop.run_once()
    assert caplog.messages == [
        "mode raw, requested by 'operator' (before: full)",
        "mode no_gps, requested by 'operator' (before: raw)",
    ]
