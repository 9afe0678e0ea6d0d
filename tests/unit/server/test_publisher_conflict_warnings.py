"""A publisher conflict in the loop: counted, a health warning, logged once, and by default ignored."""

from __future__ import annotations

from typing import Any

import pytest
from support_samples import START, ScriptedLocalizer, imu, start_core, write_vehicle

from modelserver.config.vehicle_file import load_config
from modelserver.messages import Health, JointSample, JointsSample, SensorHeader
from modelserver.server.bus import FakeBus
from modelserver.server.clock import FakeClock
from modelserver.server.ingress import CONFLICT_TIMEOUT_NS, SensorChannel
from modelserver.server.loop import Loop, LoopSettings
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import Sender


class Rig:
    """A loop that detects publisher conflicts, and one IMU."""

    def __init__(self, rule: Any = "ignore", publishers: dict[str, frozenset[str]] | None = None):
        self.clock = FakeClock(START)
        self.bus = FakeBus(self.clock)
        sensors = {"IMU": SensorChannel("imu_t"), "JOINTS": SensorChannel("joints_t")}
        settings = LoopSettings(
            20_000_000,
            sensors,
            publisher_conflict=rule,
            shared_channels=frozenset({"JOINTS"}),
            publishers=publishers or {},
        )
        self.loop = Loop(self.bus, self.clock, start_core(ScriptedLocalizer()), settings)
        self.number = 0

    def publish(self, count: int = 1, other: str = "", age_s: float = 0.0) -> None:
        """Publish IMU samples at 100 Hz, with `other` also those of a second publisher."""
        for _ in range(count):
            self.clock.advance(0.01)
            self.number += 1
            self.put("imu", self.number, self.clock.utime())
            if other:
                self.put(other, 90_000 + self.number, self.clock.utime() - 1 - round(age_s * 1e6))
            self.loop.run_once()

    def put(self, source: str, seq: int, utime: int, sender: Sender = None) -> None:
        sample = imu(utime, source)
        header = SensorHeader(utime, source, seq)
        data = encode(type(sample)(header, sample.angular_velocity, sample.specific_force))
        self.bus.sensors.put("IMU", data, sender)

    def publish_joints(self, source: str, number: int, *names: str) -> None:
        header = SensorHeader(START + number * 1000, source, number)
        sample = JointsSample(header, tuple(JointSample(name, 0.1) for name in names))
        self.bus.sensors.put("JOINTS", encode(sample))

    @property
    def health(self) -> Health:
        health: Health = decode("health_t", self.bus.get_published("MODELSERVER_HEALTH")[-1])
        return health

    @property
    def accepted(self) -> int:
        accepted: int = self.loop.state.localizer.count  # type: ignore[union-attr]
        return accepted


@pytest.mark.slow
@pytest.mark.parametrize(("rule", "used"), [("ignore", 57), ("use", 64), ("", 64)])
def test_given_another_source_on_the_channel_then_the_first_owns_it(
    rule: str, used: int, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig(rule)
    rig.publish(50)
    rig.publish(7, other="intruder")
    assert rig.accepted == used
    counted = rig.loop.state.rejected.get(("IMU", "publisher_conflict"), 0)
    assert counted == (7 if rule else 0)
    if not rule:
        assert rig.loop.state.warnings == {}
        return
    text = rig.loop.state.warnings["channel IMU"]
    assert "sources 'imu' and 'intruder' publish on IMU at once" in text
    assert ("ignored" in text) is (rule == "ignore")
    assert sum("intruder" in message for message in caplog.messages) == 1
    rig.publish(100)
    assert ("channel IMU", text) in rig.health.warnings
    # until it has ended for a while
    rig.publish(CONFLICT_TIMEOUT_NS // 10_000_000 + 1)
    assert rig.health.warnings == ()


def test_given_a_recording_played_beside_the_driver_then_the_warning_suspects_it() -> None:
    rig = Rig()
    rig.publish(50)
    rig.publish(10, other="imu", age_s=86_400.0)
    # its first two samples could be from a restarted driver
    assert rig.loop.state.rejected["IMU", "publisher_conflict"] in (8, 9)
    text = rig.loop.state.warnings["channel IMU"]
    assert "two publishers with source 'imu'" in text
    assert "86,400 s old: a recording" in text


def test_given_a_name_with_control_characters_then_warning_and_log_are_clean(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()
    rig.publish(5)
    rig.publish(5, other="x\nERROR\x1b[31m")
    assert rig.loop.state.warnings["channel IMU"].isprintable()
    rig.publish(200)
    assert all(message.isprintable() for message in caplog.messages)


def test_given_several_drivers_of_joints_then_they_share_the_channel() -> None:
    rig = Rig()
    for n in range(20):
        rig.publish_joints("arm", n, "Shoulder", "Elbow")
        rig.publish_joints("axis", n, "Mounted")
    rig.loop.run_once()
    assert not any(why == "publisher_conflict" for _, why in rig.loop.state.rejected)
    assert rig.loop.state.traffic["sensor:axis"].count == 20


@pytest.mark.parametrize("rule", ["ignore", "use"])
def test_given_two_drivers_of_one_joint_then_it_has_one_of_them_and_their_other_joints_are_used(rule: str) -> None:
    rig = Rig(rule)
    for n in range(20):
        rig.publish_joints("axis", n, "Mounted")
        rig.publish_joints("arm", n, "Mounted", "Elbow")
        rig.publish_joints("intruder", n, "Mounted")
    rig.loop.run_once()
    assert rig.loop.state.rejected["JOINTS", "publisher_conflict"] == (20 if rule == "ignore" else 40)
    text = rig.loop.state.warnings["channel JOINTS Mounted"]
    assert text.startswith("sources 'axis' and 'arm' publish on JOINTS Mounted at once")
    assert "channel JOINTS Elbow" not in rig.loop.state.warnings
    assert rig.loop.state.traffic["sensor:arm"].count == 20
    assert ("sensor:intruder" in rig.loop.state.traffic) is (rule == "use")


def test_given_a_stranger_that_was_first_then_the_source_that_the_vehicle_file_names_takes_the_channel() -> None:
    rig = Rig(publishers={"IMU": frozenset({"imu"})})
    rig.put("intruder", 1, rig.clock.utime())
    rig.loop.run_once()
    rig.publish(50, other="intruder")
    assert rig.accepted == 1 + 50
    assert "sources 'imu' and 'intruder'" in rig.loop.state.warnings["channel IMU"]
    assert set(rig.loop.state.rejected) == {("IMU", "publisher_conflict")}


def test_given_a_stranger_whose_numbers_are_ahead_by_one_then_every_sample_of_the_driver_is_used() -> None:
    rig = Rig()
    for n in range(1, 301):
        rig.clock.advance(0.005)
        rig.put("imu", n, rig.clock.utime(), ("10.0.0.1", 4000))
        rig.put("imu", n + 1, rig.clock.utime() + 1, ("10.0.0.9", 5000))
        rig.loop.run_once()
    assert rig.accepted == 300
    # counted together once a second
    assert set(rig.loop.state.rejected) == {("IMU", "publisher_conflict")}


def test_given_a_restarted_driver_then_it_is_used_at_once_though_its_address_is_another() -> None:
    rig = Rig()
    for n in range(1, 101):
        rig.clock.advance(0.01)
        rig.put("imu", n, rig.clock.utime(), ("10.0.0.1", 4000))
    rig.loop.run_once()
    rig.clock.advance(0.5)
    for n in range(1, 101):
        rig.clock.advance(0.01)
        rig.put("imu", n, rig.clock.utime(), ("10.0.0.1", 4001))
    rig.loop.run_once()
    assert rig.accepted == 200
    assert not rig.loop.state.rejected


def test_given_the_vehicle_file_then_a_second_publisher_is_ignored_unless_configured_otherwise(tmp_path: Any) -> None:
    path = write_vehicle(tmp_path)
    assert load_config(path).sensors.publisher_conflict == "ignore"
    path.write_text(path.read_text().replace("sensors:\n", "sensors:\n  publisher_conflict: use\n"))
    assert load_config(path).sensors.publisher_conflict == "use"
