"""A second writer on a sensor's channel: counted, noticed in the health, logged once, and by configuration ignored."""

from __future__ import annotations

from typing import Any

import pytest
from support_samples import START, Scripted, imu, started, write_vehicle

from modelserver.config import load_config
from modelserver.core.writers import RIVAL_NS
from modelserver.messages import Health, JointSample, JointsSample, SensorHeader
from modelserver.service.clock import FakeClock
from modelserver.service.fake_bus import FakeBus
from modelserver.service.heard import SensorChannel
from modelserver.service.loop import Loop, LoopSettings
from modelserver.wire.codec import decode, encode


class Rig:
    """A loop that looks for second writers, and one inertial unit that speaks."""

    def __init__(self, rule: Any = "ignore"):
        self.clock = FakeClock(START)
        self.bus = FakeBus(self.clock)
        sensors = {"IMU": SensorChannel("imu_t"), "JOINTS": SensorChannel("joints_t")}
        settings = LoopSettings(20_000_000, sensors, second_writer=rule, shared=frozenset({"JOINTS"}))
        self.loop = Loop(self.bus, self.clock, started(Scripted()), settings)
        self.number = 0

    def speak(self, count: int = 1, other: str = "", age_s: float = 0.0) -> None:
        """Have the unit speak at 100 Hz, and with `other` someone else beside it."""
        for _ in range(count):
            self.clock.advance(0.01)
            self.number += 1
            self.put("imu", self.number, self.clock.utime())
            if other:
                self.put(other, 90_000 + self.number, self.clock.utime() - 1 - round(age_s * 1e6))
            self.loop.turn()

    def put(self, source: str, seq: int, utime: int) -> None:
        sample = imu(utime, source)
        header = SensorHeader(utime, source, seq)
        self.bus.sensors.put("IMU", encode(type(sample)(header, sample.angular_velocity, sample.specific_force)))

    @property
    def health(self) -> Health:
        health: Health = decode("health_t", self.bus.said("MODELSERVER_HEALTH")[-1])
        return health

    @property
    def taken(self) -> int:
        taken: int = self.loop.state.localizer.taken  # type: ignore[union-attr]
        return taken


@pytest.mark.parametrize(("rule", "used"), [("ignore", 57), ("use", 64), ("", 64)])
def test_given_another_name_on_the_channel_then_the_first_keeps_it(
    rule: str, used: int, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig(rule)
    rig.speak(50)
    rig.speak(7, other="intruder")
    assert rig.taken == used
    counted = rig.loop.state.rejected.get(("IMU", "second_writer"), 0)
    assert counted == (7 if rule else 0)
    if not rule:
        assert rig.loop.state.notices == {}
        return
    text = rig.loop.state.notices["channel IMU"]
    assert "'imu' and 'intruder' speak on IMU at once" in text
    assert ("ignored" in text) is (rule == "ignore")
    assert sum("intruder" in message for message in caplog.messages) == 1
    rig.speak(100)
    assert ("channel IMU", text) in rig.health.notices
    # until it has been gone for a while
    rig.speak(RIVAL_NS // 10_000_000 + 1)
    assert rig.health.notices == ()


def test_given_a_recording_played_beside_the_unit_then_the_notice_guesses_so() -> None:
    rig = Rig()
    rig.speak(50)
    rig.speak(10, other="imu", age_s=86_400.0)
    # its first two samples could have been those of a driver that was started anew
    assert rig.loop.state.rejected["IMU", "second_writer"] in (8, 9)
    text = rig.loop.state.notices["channel IMU"]
    assert "two of the name 'imu'" in text
    assert "86,400 s old: a recording" in text


def test_given_a_name_with_control_characters_then_notice_and_log_are_clean(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig()
    rig.speak(5)
    rig.speak(5, other="x\nERROR\x1b[31m")
    assert rig.loop.state.notices["channel IMU"].isprintable()
    rig.speak(200)
    assert all(message.isprintable() for message in caplog.messages)


def test_given_several_drivers_of_joints_then_they_share_the_channel() -> None:
    rig = Rig()
    for n in range(20):
        for source in ("arm", "axis"):
            header = SensorHeader(START + n * 1000, source, n)
            rig.bus.sensors.put("JOINTS", encode(JointsSample(header, (JointSample("Mounted", 0.1),))))
    rig.loop.turn()
    assert not any(why == "second_writer" for _, why in rig.loop.state.rejected)
    assert rig.loop.state.traffic["sensor:axis"].count == 20


def test_given_the_vehicle_file_then_second_writers_are_ignored_unless_it_says_otherwise(tmp_path: Any) -> None:
    path = write_vehicle(tmp_path)
    assert load_config(path).sensors.second_writer == "ignore"
    path.write_text(path.read_text().replace("sensors:\n", "sensors:\n  second_writer: use\n"))
    assert load_config(path).sensors.second_writer == "use"
