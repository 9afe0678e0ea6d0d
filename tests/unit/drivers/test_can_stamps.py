"""When a CAN frame came, though it was read later: the stamps of samples, the frames of one instant, the way rolled."""

from __future__ import annotations

import math
import struct
import time
from typing import Any

import can
import pytest
from support_vehicle_bus import START_UTIME, at, raptor_dbc, wheels_settings

from modelserver.messages import WheelsSample
from msdrivers.devices.wheels import WheelsDriver
from msdrivers.endpoint import CanFrame, MeasuredSample
from msdrivers.links import LinkError
from msdrivers.links import can_bus as can_module
from msdrivers.links.can_bus import CanLink


def pair(n: int, t: float) -> list[CanFrame]:
    """Return the two frames of the instant `t`, n counts after the first, with the stamp of their coming."""
    utime = START_UTIME + round(t * 1e6)
    counts = struct.pack("<HHBBxx", n, n, 1, 1)
    return [CanFrame(0x100, counts, utime=utime), CanFrame(0x101, bytes(4), utime=utime + 200)]


def samples(frames: list[CanFrame], read: float) -> tuple[WheelsDriver, list[WheelsSample]]:
    """Return what a driver publishes that reads all frames at one instant."""
    driver = WheelsDriver(wheels_settings(frame_delay=0.0), raptor_dbc())
    driver.on_open(at(0.0))
    outputs = [output for frame in frames for output in driver.on_receive(frame, at(read))]
    return driver, [output.sample for output in outputs if isinstance(output, MeasuredSample)]  # type: ignore[misc]


def test_given_frames_that_waited_to_be_read_then_each_sample_has_the_instant_of_its_own() -> None:
    driver, found = samples([frame for n in range(20) for frame in pair(10 * n, 0.02 * n)], 0.4)
    assert [sample.header.host_utime - START_UTIME for sample in found] == [20_000 * n for n in range(20)]
    # the wheels may well have rolled 2.4 m in 0.38 s, and could not have in no time
    assert found[-1].wheels[0].travel == pytest.approx(190 * 0.0125)
    assert driver.counts["rejected.jump"] == 0


@pytest.mark.parametrize("lost", range(2))
def test_given_a_frame_lost_among_those_that_waited_then_no_later_one_is_joined_to_another_instant(lost: int) -> None:
    frames = [frame for n in range(20) for frame in pair(10 * n, 0.02 * n)]
    del frames[10 + lost]
    driver, found = samples(frames, 0.4)
    assert driver.counts["incomplete"] == 1
    assert sum(math.isnan(sample.wheels[0].travel) for sample in found) <= 1
    assert [sample.header.host_utime for sample in found[-5:]] == [START_UTIME + 20_000 * n for n in range(15, 20)]


@pytest.mark.parametrize("utime", [0, START_UTIME + 10_000_000])
def test_given_no_stamp_or_one_of_the_future_then_a_frame_came_when_it_was_read(utime: int) -> None:
    frames = [CanFrame(0x100, bytes(8), utime=utime), CanFrame(0x101, bytes(4), utime=utime)]
    _, (sample,) = samples(frames, 0.4)
    assert sample.header.host_utime == at(0.4).utime


class Bus:
    """A scripted python-can bus."""

    def __init__(self) -> None:
        self.coming: list[can.Message] = []
        self.error: Exception | None = None

    def recv(self, timeout: float) -> can.Message | None:
        if self.error is not None:
            raise self.error
        return self.coming.pop(0) if self.coming else None

    def send(self, message: can.Message, timeout: float) -> None:
        if self.error is not None:
            raise self.error

    def shutdown(self) -> None:
        if self.error is not None:
            raise self.error


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    made = Bus()
    monkeypatch.setattr(can_module.can, "Bus", lambda **_: made)
    return made


def make_stamped(seconds_ago: float) -> can.Message:
    return can.Message(arbitration_id=1, timestamp=time.time() - seconds_ago)


def test_given_stamps_of_the_hosts_clock_then_they_are_taken_where_they_can_be(bus: Bus) -> None:
    link = CanLink("can0")
    link.open()
    bus.coming = [make_stamped(0.0), make_stamped(-60.0), make_stamped(60.0), can.Message(arbitration_id=1)]
    sound, ahead, past, none = link.poll(0.0)
    assert abs(sound.utime - time.time_ns() // 1000) < 10_000_000
    assert (ahead.utime, past.utime, none.utime) == (0, 0, 0)


def test_given_an_interface_that_stamps_by_a_clock_of_its_own_then_its_stamps_are_not_taken(bus: Bus) -> None:
    link = CanLink("PCAN_USBBUS1", "pcan")
    link.open()
    bus.coming = [make_stamped(0.0)]
    assert link.poll(0.0)[0].utime == 0


def test_given_multicast_then_own_frames_are_not_received_and_those_of_others_are(bus: Bus) -> None:
    link = CanLink("239.74.163.2:5000", "udp_multicast")
    link.open()
    one, two = CanFrame(0x300, b"1"), CanFrame(0x300, b"2")
    for frame in (one, two, one):
        link.send(frame)

    def message(frame: CanFrame) -> can.Message:
        return can.Message(arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False)

    bus.coming = [message(frame) for frame in (one, two, CanFrame(0x300, b"3"), one, one)]
    assert link.poll(0.0) == [CanFrame(0x300, b"3"), one]


@pytest.mark.parametrize(("interface", "received"), [("socketcan", 1), ("gs_usb", 0)])
def test_given_a_frame_that_was_sent_on_this_machine_then_it_is_received_where_another_program_can_have_sent_it(
    interface: str, received: int, bus: Bus
) -> None:
    link = CanLink("can0", interface)
    link.open()
    bus.coming = [can.Message(arbitration_id=1, is_rx=False)]
    assert len(link.poll(0.0)) == received


@pytest.mark.parametrize("error", [TypeError("missing 2 arguments"), NameError("name 'canlib'"), ImportError("no lib")])
def test_given_an_interface_that_fails_in_its_own_way_then_it_is_a_link_error(
    error: Exception, bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(**_: Any) -> None:
        raise error

    link = CanLink("0", "kvaser")
    link.open()
    bus.error = error
    for ask in (lambda: link.poll(0.0), lambda: link.send(CanFrame(1))):
        with pytest.raises(LinkError):
            ask()
    link.close()
    monkeypatch.setattr(can_module.can, "Bus", fails)
    with pytest.raises(LinkError, match="can 0"):
        CanLink("0", "kvaser").open()
