"""What goes wrong with a 3DM-GX1 and its line, and what the driver makes of it."""

from __future__ import annotations

import itertools
import random

import pytest
from support_gx1 import Line, RepeatingDevice, rotating_samples

from msdrivers.devices import gx1 as requests
from msdrivers.devices.gx1 import CommandByte, EepromAddress, Gains, Gx1Driver, Gx1Packet, Gx1Settings
from msdrivers.emulate import FaultInjector, InjectedFault
from msdrivers.emulate.imu import Gx1Emulator, make_eeprom
from msdrivers.endpoint import EndpointPhase, Send


def device_times(line: Line) -> list[int]:
    return [measured.sample.header.device_utime for measured in line.samples]


def line_with(*faults: InjectedFault, settings: Gx1Settings | None = None, **more: object) -> Line:
    samples = rotating_samples()
    device = FaultInjector(lambda: Gx1Emulator(samples), faults) if faults else Gx1Emulator(samples)
    return Line(Gx1Driver(settings or Gx1Settings("imu")), device, **more)  # type: ignore[arg-type]


def test_given_noise_between_replies_then_most_samples_come_and_every_one_is_true():
    rng = random.Random(5)
    line = line_with(pieces=rng, corrupt=lambda unit: rng.randbytes(rng.randrange(8)) + unit)
    line.run(20.0)
    times = device_times(line)
    steps = [b - a for a, b in itertools.pairwise(times)]
    assert set(steps) == {10_000}
    assert line.host.counts["skipped"] > 5000
    assert line.host.counts.get("restarts", 0) == 0


def test_given_a_line_that_spoils_one_byte_in_a_hundred_then_no_false_value_is_published():
    # with two bits of one value that cancel in the sum no receiver can help: none are in this series
    rng = random.Random(7)
    line = line_with(
        corrupt=lambda unit: bytes(byte ^ (1 << rng.randrange(8)) if rng.random() < 0.01 else byte for byte in unit)
    )
    line.run(30.0)
    assert len(line.samples) > 1500
    for measured in line.samples:
        assert measured.sample.angular_velocity == pytest.approx((0.0, 0.0, 0.2), abs=2e-4)
    times = device_times(line)
    assert times == sorted(set(times))
    assert line.host.counts["rejected.checksum"] > 100


def test_given_dropped_and_corrupt_replies_then_they_are_missing_and_counted_and_nothing_is_repeated():
    line = line_with(InjectedFault(4.0, "drop", 3), InjectedFault(5.0, "corrupt", 2))
    line.run(7.0)
    times = device_times(line)
    steps = [b - a for a, b in itertools.pairwise(times) if b - a != 10_000]
    assert steps == [40_000, 30_000]
    assert line.host.counts["rejected.checksum"] == 2


def test_given_replies_that_come_twice_then_each_is_published_once():
    line = line_with(corrupt=lambda unit: unit * 2)
    line.run(7.0)
    times = device_times(line)
    assert len(times) == len(set(times)) > 300
    assert line.host.counts["rejected.repeated"] >= len(times) - 1


def test_given_a_restart_then_it_is_detected_and_the_device_is_set_up_again():
    line = line_with(InjectedFault(5.0, "restart"))
    line.run(12.0)
    (silent,) = line.status_texts(EndpointPhase.SILENT)
    assert "no usable message 49 for 0.5 s" in silent
    assert (
        line.status_texts(EndpointPhase.STREAMING) == ["3DM-GX1 serial 1234, firmware 3.1.00, receiving message 49"] * 2
    )
    times = device_times(line)
    assert times == sorted(times)
    gaps = [b - a for a, b in itertools.pairwise(times) if b - a != 10_000]
    # the device's time goes ahead by more than a turn of its counter, and so cannot pass for the one before
    assert len(gaps) == 1
    assert gaps[0] > 655_360_000
    assert line.host.counts["restarts"] == 1


def test_given_a_jump_of_the_ticks_then_it_is_detected_and_the_device_is_set_up_again():
    line = line_with(InjectedFault(5.0, "jump", 20_000))
    line.run(9.0)
    assert any("no usable message 49" in text for text in line.status_texts(EndpointPhase.SILENT))
    assert line.host.counts["rejected.ticks"] == pytest.approx(50, abs=2)
    assert line.host.counts["restarts"] == 1
    assert line.status_texts(EndpointPhase.STREAMING)[-1].endswith("receiving message 49")
    assert len(line.samples) > 500


def test_given_ticks_that_run_backwards_then_nothing_is_published_and_it_is_reported():
    line = line_with(settings=Gx1Settings("imu", tick=0.01))
    line.run(3.0)
    published = len(line.samples)
    driver = line.host
    # from now on a device that counts down
    outputs, texts = [], []
    for k in range(200):
        line.now_ns += 10_000_000
        raw = reply_at((30_000 - k) % 65_536)
        outputs += driver.on_receive(raw, line.now())
        due = driver.get_deadline()
        if due is not None and due <= line.now_ns:
            texts = [output.text for output in driver.on_timer(line.now()) if hasattr(output, "text")]
            if texts:
                break
    assert published > 100
    assert outputs == []
    assert "no usable message 49" in texts[0]
    assert driver.counts["rejected.ticks"] > 10


def reply_at(ticks: int) -> bytes:
    return Gx1Packet(CommandByte.EULER_VECTORS, (1, 2, 3, 4, 5, 6, 7, 8, 9), ticks).to_bytes()


def test_given_a_stall_then_it_is_silent_and_afterwards_streams_again_without_old_values():
    line = line_with(InjectedFault(5.0, "stall", 3.0))
    line.run(14.0)
    assert line.status_texts(EndpointPhase.SILENT)
    hosts = [measured.sample.header.host_utime for measured in line.samples]
    gaps = [b - a for a, b in itertools.pairwise(hosts) if b - a > 100_000]
    assert len(gaps) == 1
    assert 3_000_000 < gaps[0] < 7_000_000
    times = device_times(line)
    assert times == sorted(set(times))


def test_given_a_host_that_was_busy_for_two_seconds_then_what_waited_is_published_with_its_own_times():
    line = line_with(settings=Gx1Settings("imu", silence=5.0))
    line.run(4.0)
    device, driver = line.device, line.host
    waiting = b""
    for _ in range(200):
        line.now_ns += 10_000_000
        waiting += b"".join(o.unit for o in device.on_timer(line.now()) if isinstance(o, Send))
    before = len(line.samples)
    line.samples += driver.on_receive(waiting, line.now())  # type: ignore[arg-type]
    times = device_times(line)
    assert len(times) - before >= 199
    assert {b - a for a, b in itertools.pairwise(times)} == {10_000}
    assert driver.counts.get("restarts", 0) == 0


@pytest.mark.parametrize(
    ("gains", "text"),
    [
        (Gains(0, 7000, 2000), "the gyro gain in its EEPROM (address 130) is 0"),
        (Gains(8500, 0, 2000), "the accelerometer gain in its EEPROM (address 230) is 0"),
        (Gains(8500, 7000, 0xFFFF), "the magnetometer gain in its EEPROM (address 232) is 65535"),
        (Gains(64, 7000, 2000), "that of the older 3DM-G"),
    ],
)
def test_given_gains_that_scale_nothing_then_nothing_is_published_and_the_fix_is_reported(gains, text):
    device = Gx1Emulator(rotating_samples(), make_eeprom(gains))
    line = Line(Gx1Driver(Gx1Settings("imu")), device)
    line.run(5.0)
    assert line.samples == []
    (silent,) = line.status_texts(EndpointPhase.SILENT)
    assert text in silent
    assert "nothing is published, trying again in 5 s" in silent
    # repaired meanwhile: the driver continues by itself
    device.eeprom = make_eeprom()
    line.run(6.0)
    assert line.samples


def test_given_timer_words_of_zero_then_the_fix_is_reported():
    device = Gx1Emulator(rotating_samples(), make_eeprom(timer=(0, 0, 0, 0)))
    line = Line(Gx1Driver(Gx1Settings("imu")), device)
    line.run(6.0)
    assert "write the defaults 16 16 256 1" in line.status_texts(EndpointPhase.SILENT)[0]
    assert line.samples == []


def test_given_a_gps_on_the_port_then_it_is_reported_what_was_received_at_which_baud_rates():
    line = Line(Gx1Driver(Gx1Settings("imu")), RepeatingDevice(b"$GPGGA,123519,4807.038,N*47\r\n"), baud=115200)
    line.run(30.0)
    silent = line.status_texts(EndpointPhase.SILENT)[0]
    assert "no 3DM-GX1 answers on this line: at 38400 baud received " in silent
    assert "at 115200 baud received " in silent
    assert "$GPGGA,123519,4807.038,N" in silent
    assert "check port and baud rate" in silent
    assert {reopen.baud for reopen in line.reopens} == {38400, 115200}
    assert line.samples == []


def test_given_nobody_on_the_port_then_it_is_reported_that_nothing_was_received():
    line = Line(Gx1Driver(Gx1Settings("imu")), RepeatingDevice(b""))
    line.run(9.0)
    silent = line.status_texts(EndpointPhase.SILENT)[0]
    assert "at 38400 baud received nothing: check power, cable and port; at 115200 baud received nothing" in silent
    assert line.host.on_close(line.now()) == []


def test_given_a_device_at_the_second_baud_rate_then_it_is_found_there():
    line = Line(Gx1Driver(Gx1Settings("imu")), Gx1Emulator(rotating_samples()), baud=115200)
    line.run(9.0)
    assert [reopen.baud for reopen in line.reopens] == [115200]
    assert any("answers at 115200 baud" in text for text in line.status_texts())
    assert line.samples


def test_given_random_bytes_for_a_device_then_nothing_is_published():
    rng = random.Random(9)
    speaker = RepeatingDevice(b"\0" * 100, 0.01)
    line = Line(Gx1Driver(Gx1Settings("imu")), speaker, corrupt=lambda unit: rng.randbytes(len(unit)))
    line.run(30.0)
    assert line.samples == []
    assert line.status_texts(EndpointPhase.SILENT)


def test_given_a_late_answer_to_a_read_that_was_asked_twice_then_it_is_not_taken_for_the_next():
    line = line_with()
    late: list[bytes] = []

    def spoil(unit: bytes) -> bytes:
        if unit[0] != CommandByte.READ_EEPROM or late:
            return unit
        # comes just after the same was asked again, and before the reply to that
        late.append(unit)
        line._to_host.append((line.now_ns + 499_000_000, unit))
        return b""

    line.corrupt = spoil
    line.run(6.0)
    # twice for the answer that was late, and once more to compare
    assert line.sent.count(requests.make_read_eeprom(EepromAddress.GYRO_GAIN)) == 3
    assert line.samples[-1].sample.specific_force == pytest.approx((0.0, 0.0, -9.80665), abs=2e-3)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (CommandByte.EULER_VECTORS, (0, 16_385, 0, 0, 0, 0, 0, 0, 0)),
        (CommandByte.QUATERNION_VECTORS, (0,) * 13),
        (CommandByte.QUATERNION_VECTORS, (8192, 8192, *(0,) * 11)),
    ],
)
def test_given_an_orientation_that_cannot_be_then_the_reply_is_rejected(message, words):
    line = line_with(settings=Gx1Settings("imu", message=message))
    line.run(3.0)
    ticks = round(line.samples[-1].sample.header.device_utime / 10_000) % 65_536 + 1
    line.now_ns += 10_000_000
    assert line.host.on_receive(Gx1Packet(message, words, ticks).to_bytes(), line.now()) == []
    assert line.host.counts["rejected.content"] == 1


def test_given_the_line_reopened_after_it_was_lost_then_it_is_set_up_again():
    line = line_with()
    line.run(4.0)
    before = len(line.samples)
    line._to_host.clear()
    line._from_host(line.host.on_open(line.now()))
    line.run(4.0)
    assert len(line.samples) > before + 200
    line.close()
    assert line.device.streamed == 0


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.3, 0.55, 0.7, 0.95, 1.05, 1.2, 1.4])
def test_given_replies_that_are_late_then_no_gain_is_taken_for_another(late_s: float):
    line = line_with()
    assert isinstance(line.device, Gx1Emulator)
    line.device.eeprom |= {EepromAddress.GYRO_GAIN: 8500, EepromAddress.ACCELEROMETER_GAIN: 7000}
    line.corrupt = lambda unit: (line._to_host.append((line.now_ns + round(late_s * 1e9), unit)), b"")[1]  # type: ignore[func-returns-value]
    line.run(40.0)
    for measured in line.samples:
        assert measured.sample.specific_force == pytest.approx((0.0, 0.0, -9.80665), abs=2e-3)
        assert measured.sample.angular_velocity == pytest.approx((0.0, 0.0, 0.2), abs=2e-4)


@pytest.mark.parametrize("gain", [0, 1, 3, 999, 32767, 65535])
def test_given_a_gain_that_no_unit_has_then_it_is_reported_and_nothing_is_published(gain: int):
    line = line_with()
    assert isinstance(line.device, Gx1Emulator)
    line.device.eeprom |= {EepromAddress.ACCELEROMETER_GAIN: gain}
    line.run(4.0)
    assert not line.samples
    assert (
        f"the accelerometer gain in its EEPROM (address 230) is {gain}, and no 3DM-GX1"
        in line.status_texts(EndpointPhase.SILENT)[0]
    )


def test_given_a_line_without_baud_rates_when_nobody_answers_then_none_is_named_or_tried():
    line = line_with(settings=Gx1Settings("imu", bauds=()), corrupt=lambda unit: b"")
    line.run(20.0)
    silent = line.status_texts(EndpointPhase.SILENT)[0]
    assert silent.startswith("no 3DM-GX1 answers on this line: received nothing: check power, cable and port")
    assert not line.reopens
    line = line_with(settings=Gx1Settings("imu", bauds=()))
    line.run(3.0)
    assert line.samples
    assert "3DM-GX1 serial 1234, firmware 3.1.00 answers" in line.status_texts(EndpointPhase.CONFIGURING)
