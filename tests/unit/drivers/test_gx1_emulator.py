"""The emulated 3DM-GX1, asked by hand."""

from __future__ import annotations

import math

import pytest
from support_gx1 import START_UTIME, Line, angle_between, stationary_samples

from modelserver.earth.geodesy import Geodesy, origin_at
from modelserver.messages import ImuSample, OrientationReference, SensorHeader, YawSource
from modelserver.simulation import DrivePhase, ImuModel, Trajectory
from modelserver.simulation.sensors import MagnetometerModel, Run, simulate_imu
from modelserver.transforms import so3
from modelserver.transforms.pose import Pose
from msdrivers.devices import gx1 as requests
from msdrivers.devices.gx1 import CommandByte, Gx1Driver, Gx1Packet, Gx1Settings, Gx1Stream
from msdrivers.emulate.imu import Gx1Emulator, Gx1Unit
from msdrivers.endpoint import HostTime, Send

S = 1_000_000_000


class Hand:
    """Asks a device and reads all that it answers."""

    def __init__(self, device: Gx1Emulator):
        self.device, self.ns = device, 5 * S
        self.parser = Gx1Stream()
        device.on_open(self.now())

    def now(self) -> HostTime:
        return HostTime(self.ns, START_UTIME + (self.ns - 5 * S) // 1000)

    def ask(self, request: bytes = b"", wait: float = 0.005) -> list[Gx1Packet]:
        """Send a request; return what comes until `wait` seconds later."""
        raw = b"".join(o.unit for o in self.device.on_receive(request, self.now()) if isinstance(o, Send))
        until = self.ns + round(wait * S)
        while (due := self.device.get_deadline()) is not None and due <= until:
            self.ns = max(due, self.ns)
            raw += b"".join(o.unit for o in self.device.on_timer(self.now()) if isinstance(o, Send))
        self.ns = until
        return self.parser.feed(raw)


def sample(at: float, orientation: so3.Quaternion, reference: OrientationReference) -> ImuSample:
    return ImuSample(
        SensorHeader(START_UTIME + round(at * 1e6)), orientation=orientation, orientation_reference=reference
    )


def test_given_the_end_of_the_samples_then_it_streams_no_more_and_reports_its_temperature():
    hand = Hand(Gx1Emulator(stationary_samples(0.5), unit=Gx1Unit(streamed_at_start=CommandByte.EULER_VECTORS)))
    assert len(hand.ask(wait=0.6)) == 51
    assert hand.ask(bytes((CommandByte.EULER_VECTORS,)), 0.1) == []
    assert [packet.command for packet in hand.ask(bytes((CommandByte.TEMPERATURE,)))] == [CommandByte.TEMPERATURE]


def test_given_a_stream_and_a_poll_then_replies_come_whole_in_order_with_ticks_that_rise():
    hand = Hand(Gx1Emulator(stationary_samples(), unit=Gx1Unit(tick_offset=65_530)))
    started = hand.ask(requests.make_stream(CommandByte.STABILIZED_EULER))[0]
    assert started.field("streamed") == (CommandByte.STABILIZED_EULER,)
    found = hand.ask(wait=0.1) + hand.ask(bytes((CommandByte.TEMPERATURE,)), 0.1)
    assert [packet.command for packet in found].count(CommandByte.TEMPERATURE) == 1
    ticks = [(packet.ticks + 6) % 65_536 for packet in found if packet.ticks is not None]
    assert ticks == sorted(ticks)
    assert ticks[-1] == 20
    assert hand.parser.counts["skipped"] == 0


def test_given_a_command_that_cannot_be_streamed_then_it_is_not_answered():
    device = Gx1Emulator(stationary_samples())
    assert Hand(device).ask(requests.make_stream(CommandByte.TEMPERATURE)) == []
    assert device.streamed == 0


def test_given_an_address_without_a_word_then_it_reads_zero():
    hand = Hand(Gx1Emulator(stationary_samples()))
    assert hand.ask(b"\x28\x00\x83")[0].unsigned == 0
    assert hand.ask(b"\x28\x40\x00")[0].unsigned == 0


def test_given_a_simulated_drive_then_the_driver_gives_back_what_the_simulated_unit_felt():
    mount = Pose.from_rpy((0.0, 0.0, 0.0), math.pi, 0.0, 0.0)
    geodesy = Geodesy(origin_at(50.27, -111.18, 700.0))
    drive = Trajectory(
        [DrivePhase(2.0), DrivePhase(4.0, speed=4.0), DrivePhase(6.0, curvature=0.1), DrivePhase(4.0, speed=0.0)]
    )
    model = ImuModel(magnetometer=MagnetometerModel(), yaw_source=YawSource.MAGNETIC)
    made = simulate_imu(model, Run(drive, geodesy, START_UTIME, seed=1), mount)
    felt = {each.header.utime: each for each, _ in zip(made, range(1500), strict=False)}
    settings = Gx1Settings("imu", message=CommandByte.QUATERNION_VECTORS, heading="magnetic")
    line = Line(Gx1Driver(settings), Gx1Emulator(felt.values()))
    line.run(14.0)
    assert len(line.samples) > 1200
    for measured in line.samples:
        got = measured.sample
        assert isinstance(got, ImuSample)
        truth = felt[got.header.host_utime - 5000]
        assert got.angular_velocity == pytest.approx(truth.angular_velocity, abs=1.4e-4)
        assert got.specific_force == pytest.approx(truth.specific_force, abs=1.1e-3)
        assert got.magnetic_field == pytest.approx(truth.magnetic_field, abs=4e-9)
        assert got.orientation is not None
        assert truth.orientation is not None
        assert angle_between(got.orientation, truth.orientation) < 3e-4
        assert got.yaw_source is YawSource.MAGNETIC
    assert not any("specific_force_sign" in text for text in line.status_texts())
