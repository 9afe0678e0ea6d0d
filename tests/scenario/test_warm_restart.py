"""The real daemon killed and restarted beside a stationary vehicle: its pose is back before the vehicle moves."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from conftest import Daemon
from support_filter import RIG, simulation
from support_lcm import wait_until
from support_restart import TO_A_STOP

from modelserver.errors import ModelServerError
from modelserver.formats import save_model
from modelserver.messages import GpsSample, ImuSample
from modelserver.server.persistence import PersistedStateError, decode_state
from modelserver.simulation import DrivePhase, Event
from modelserver.wire.codec import encode

VEHICLE = """\
vehicle: car
geometry: geometry.yaml
base_frame: Car:Base
state_directory: state
sensors:
  gps: {channel: GPS, frame: Car:Antenna}
  imu: {channel: IMU, frame: Car:Imu}
  wheels: {channel: WHEELS, frames: {left: Car:Left, right: Car:Right}}
publish: {rate_hz: 50, health_hz: 20}
warm_start: {period_s: 0.5}
"""
FIRST, LOST, AGAIN = 34.0, 1.0, 6.0
AT_ONCE = 100
"""Messages between two checks that the daemon keeps up."""


def feed(daemon: Daemon, events: Iterable[Event]) -> int:
    """Publish samples as fast as the daemon processes them; return the stamp of the last."""
    channels: dict[type, str] = {GpsSample: "GPS", ImuSample: "IMU"}
    utime = 0
    for number, event in enumerate(events):
        daemon.publish(channels.get(type(event), "WHEELS"), encode(event))
        utime = max(utime, event.header.utime)
        if number % AT_ONCE == AT_ONCE - 1:
            daemon.health()
    return utime


def wait_for_start_warning(daemon: Daemon, part: str) -> str:
    return dict(daemon.health(lambda health: part in dict(health.warnings).get("start", "")).warnings)["start"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_given_a_daemon_that_ends_while_the_vehicle_is_stationary_then_its_successor_has_the_pose_at_once(
    start_daemon: Callable[..., Daemon], tmp_path: Path, number: signal.Signals
) -> None:
    geometry = save_model(RIG.model, "yaml").text
    begin = time.time_ns() // 1000 - round((FIRST + LOST + AGAIN) * 1e6)
    sim = simulation((*TO_A_STOP, DrivePhase(60.0)), start_utime=begin)
    first = start_daemon(VEHICLE, geometry=geometry)
    assert wait_for_start_warning(first, "cold start") == "cold start: no state of an earlier run is stored"
    last = feed(first, sim.events(FIRST))
    state_file = tmp_path / "state" / "state-car.json"

    def is_stored() -> bool:
        try:
            pose = decode_state(state_file.read_bytes())
        except (FileNotFoundError, PersistedStateError):
            return False
        return pose.pose is not None and pose.sensor_utime > last - 2_000_000

    assert wait_until(first.listener.bus, is_stored)
    before = first.platform().get_pose("Car:Base", "World:UTM", at=last - 200_000, wait_ms=2000)
    first.end(number)

    for _ in sim.events(LOST):
        pass
    second = start_daemon(VEHICLE, geometry=geometry)
    assert "waits for the sensors" in wait_for_start_warning(second, "warm start")
    last = feed(second, sim.events(AGAIN))
    assert "3 fixes agree" in wait_for_start_warning(second, "3 fixes agree")
    after = second.platform().get_pose("Car:Base", "World:UTM", at=last - 200_000, wait_ms=2000)
    assert before.transformation.is_valid
    assert after.transformation.is_valid
    assert after.origin == before.origin
    assert after.transformation.pose.is_close(before.transformation.pose, 1.0, 0.02)
    assert after.transformation.pose_epoch == before.transformation.pose_epoch + 1
    assert "warm start: the pose stored" in second.log
    # a state that is torn is a cold start
    second.end(signal.SIGKILL)
    state_file.write_bytes(state_file.read_bytes()[:-40])
    third = start_daemon(VEHICLE, geometry=geometry)
    assert "it is damaged" in wait_for_start_warning(third, "cold start")
    with pytest.raises(ModelServerError):
        third.platform().get_transformation("Car:Base", "World:UTM")
