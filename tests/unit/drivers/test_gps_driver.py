"""The driver of a satellite receiver against the receiver in software, and against what is no receiver."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from support_gps import SECOND, START, Line, add_noise, drive, now_at, split_in_half

from modelserver.messages import FixType, SensorHeader
from msdrivers.devices.gps.driver import GpsDriver, GpsSettings, sample_from_novatel
from msdrivers.devices.gps.nmea import encode as nmea
from msdrivers.devices.gps.novatel import (
    HeadingLog,
    LogHeader,
    NovatelLog,
    Position,
    PositionType,
    TimeStatus,
    crc32,
    encode,
)
from msdrivers.devices.stream import RequestStep, Script, ScriptRunner
from msdrivers.emulate import FaultInjector, InjectedFault
from msdrivers.emulate.gps import GpsEmulator, GpsUnit
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Send

NMEA_UNIT = GpsUnit(
    saved=tuple(f"log com1 {name} ontime 0.25" for name in ("gpgga", "gpgsa", "gpgst", "gprmc")), is_answering=False
)


def line(settings: GpsSettings | None = None, unit: GpsUnit | None = None, seconds: float = 30.0, **more) -> Line:
    driver = GpsDriver(settings or GpsSettings("gps"))
    return Line(driver, GpsEmulator(drive(seconds), unit), **more).open()


def restarting_line(boot_time: float) -> Line:
    """A line whose receiver restarts after 5 s."""
    samples = drive(30.0)
    device = FaultInjector(lambda: GpsEmulator(samples), [InjectedFault(5.0, "restart", boot_time)])
    return Line(GpsDriver(GpsSettings("gps")), device).open().run(5.0)


def position(utime_s: float = 0.0, **changes) -> bytes:
    """A BESTPOS log, `utime_s` after 2023-11-14 22:13:38 GPS."""
    status = changes.pop("time_status", TimeStatus.FINESTEERING)
    header = LogHeader("BESTPOS", 2288, 252_818_000 + round(utime_s * 1000), status, "COM1", 0, 0, True)
    body = Position(0, PositionType.SINGLE, 50.0, -111.0, 700.0, -20.0, 61, 1.0, 2.0, 3.0, "", 0.0, 0.0, 9, 8)
    return encode(NovatelLog(header, body._replace(**changes)))


def alone(*data: bytes, **settings) -> Line:
    """A driver that receives chunks of bytes every half second, without answers to its commands."""
    one = Line(GpsDriver(GpsSettings("gps", **settings)), GpsEmulator([], GpsUnit(is_answering=False))).open()
    for chunk in data:
        one.deliver(chunk)
        one.run(0.5)
    return one


@pytest.mark.parametrize("rate", [4.0, 10.0, 20.0])
def test_given_a_receiver_when_set_up_then_every_fix_comes_with_its_velocity(rate: float):
    one = line(GpsSettings("gps", rate_hz=rate)).run(5.0)
    assert one.phases == [EndpointPhase.WAITING, EndpointPhase.CONFIGURING, EndpointPhase.STREAMING], one.status_text
    assert abs(len(one.samples) - 5.0 * rate) <= 2
    assert tuple(one.device.logs) == ("bestposb", "bestvelb")
    truth = {each.header.utime: each for each in drive(30.0)}
    for each in one.samples:
        true = truth[each.header.device_utime]
        assert each.header.source == "gps"
        assert each.header.host_utime == each.header.device_utime + 20_000
        assert each.fix_type is FixType.DIFFERENTIAL
        assert each.latitude_deg == pytest.approx(true.latitude_deg, abs=1e-10)
        assert each.longitude_deg == pytest.approx(true.longitude_deg, abs=1e-10)
        assert (each.height_msl, each.undulation, each.height_ellipsoidal) == pytest.approx((700.0, -20.0, 680.0))
        assert each.position_covariance == pytest.approx(true.position_covariance, rel=1e-6)
        assert each.velocity == pytest.approx(true.velocity, abs=1e-4)
        assert each.velocity_latency == pytest.approx(0.15)
        assert (each.speed, each.course) == pytest.approx((2.0, math.pi / 4.0), abs=1e-4)
        assert each.satellites == 9
        assert math.isnan(each.hdop)
        assert math.isnan(each.baseline_yaw)
    assert [each.header.seq for each in one.samples] == list(range(len(one.samples)))
    assert one.driver.counts["skipped"] == 0


def test_given_two_antennas_when_the_heading_is_asked_for_then_it_comes_with_the_fix():
    samples = (replace(each, baseline_yaw=-2.0, baseline_yaw_sigma=0.01) for each in drive(10.0))
    driver = GpsDriver(GpsSettings("gps", heading_log="HEADING"))
    one = Line(driver, GpsEmulator(samples)).open().run(3.0)
    assert len(one.samples) > 8
    assert all(each.baseline_yaw == pytest.approx(-2.0, abs=1e-6) for each in one.samples)
    assert all(each.baseline_yaw_sigma == pytest.approx(0.01, rel=1e-5) for each in one.samples)


def test_given_a_restart_when_the_prompt_comes_then_the_receiver_is_set_up_again():
    one = restarting_line(1.5)
    before = len(one.samples)
    one.run(1.0)
    assert len(one.samples) == before
    one.run(4.0)
    assert one.driver.counts["restarts"] == 1
    assert len(one.samples) - before > 10
    assert one.phases[-2:] == [EndpointPhase.CONFIGURING, EndpointPhase.STREAMING], one.status_text
    assert "has restarted" in one.status_text


def test_given_a_restart_without_a_prompt_when_the_logs_stay_away_then_the_receiver_is_set_up_again():
    one = restarting_line(4.0)
    one.is_broken = True
    one.run(4.5)  # the prompt is lost
    one.is_broken = False
    before = len(one.samples)
    one.run(6.0)
    assert len(one.samples) - before > 8, one.status_text
    assert EndpointPhase.SILENT in one.phases
    assert "no BESTPOS for 2 s" in one.status_text


def test_given_noise_and_half_packets_when_streaming_then_only_valid_data_is_published():
    shake = add_noise(7)
    one = line(to_host=lambda data: [half for part in shake(data) for half in split_in_half(part)]).run(25.0)
    truth = {each.header.utime: each for each in drive(30.0)}
    assert len(one.samples) > 75
    assert len({each.header.device_utime for each in one.samples}) == len(one.samples)
    for each in one.samples:
        assert each.latitude_deg == pytest.approx(truth[each.header.device_utime].latitude_deg, abs=1e-10)
    assert one.driver.counts["skipped"] > 100


def test_given_a_packet_whose_second_half_is_late_when_it_comes_then_nothing_is_lost():
    whole = position()
    one = alone(whole[:50], whole[50:])
    assert [each.latitude_deg for each in one.samples] == [50.0]
    assert one.samples[0].header.host_utime == START


@pytest.mark.parametrize("bauds", [(9600, 115200, 38400), (115200, 9600)])
def test_given_another_baud_rate_when_nothing_is_understood_then_the_others_are_tried(bauds: tuple[int, ...]):
    unit = GpsUnit(saved=("log com1 bestposb ontime 0.25",))
    one = line(GpsSettings("gps", bauds=bauds), unit, device_baud=9600, baud=bauds[0]).run(12.0)
    assert one.baud == 9600, one.status_text
    assert one.phases[-1] is EndpointPhase.STREAMING
    assert len(one.reopens) == bauds.index(9600)


def test_given_a_wrong_device_when_all_rates_are_tried_then_received_data_and_attempts_are_reported():
    driver = GpsDriver(GpsSettings("gps", bauds=(9600, 115200)))
    one = Line(driver, GpsEmulator([]), is_broken=True).open()
    for _ in range(100):
        one.deliver(b"\x02LMS200 \x80\x81\x00\x03")
        one.run(0.1)
    silent = [each.text for each in one.statuses if each.phase is EndpointPhase.SILENT]
    assert silent
    assert "no NovAtel receiver" in silent[0]
    assert "at 9600 baud received" in silent[0]
    assert "at 115200 baud received" in silent[0]
    assert "LMS200" in silent[0]
    assert "check port and baud rate" in silent[0]
    assert not one.samples
    assert [each.baud for each in one.reopens[:3]] == [115200, 9600, 115200]


def test_given_a_dead_line_when_nothing_is_received_then_power_and_cable_are_named():
    one = line(is_broken=True).run(5.0)
    assert "received nothing: check power, cable and port" in one.status_text
    assert len(one.statuses) < 6, one.status_text


def test_given_a_rejected_command_when_set_up_then_the_text_of_the_receiver_is_reported():
    one = line(GpsSettings("gps", commands=("frobnicate 1",))).run(3.0)
    assert "rejected 'frobnicate 1': Invalid Message. Field = frobnicate" in one.status_text
    assert one.phases[-1] is EndpointPhase.STREAMING
    assert one.samples


def test_given_a_receiver_that_cannot_receive_when_it_sends_then_its_fixes_are_used_and_it_is_reported():
    unit = GpsUnit(saved=("log com1 bestposb ontime 0.25",), is_answering=False)
    one = line(unit=unit).run(8.0)
    assert len(one.samples) > 28
    assert "does not answer commands" in one.status_text
    assert len(one.statuses) < 6, one.status_text


def test_given_nmea_beside_bestpos_when_both_come_then_bestpos_is_used():
    settings = GpsSettings("gps", commands=("log com1 gpgga ontime 0.25", "log com1 gprmc ontime 0.25"))
    one = line(settings).run(5.0)
    assert all(each.position_covariance is not None for each in one.samples)
    assert len({each.header.device_utime for each in one.samples}) == len(one.samples)
    assert one.driver.counts["superseded"] > 12


def test_given_a_plain_nmea_receiver_when_it_sends_then_epochs_come_with_their_date():
    one = line(GpsSettings("gps", protocol="nmea"), NMEA_UNIT).run(5.0)
    assert len(one.samples) == 20
    assert one.sent == []
    last = one.samples[-1]
    assert last.header.device_utime == START + 4_750_000
    assert last.header.host_utime == last.header.device_utime + 20_000
    assert (last.hdop, last.vdop, last.pdop, last.satellites) == (0.9, 1.2, 1.5, 9)
    assert last.course == pytest.approx(math.pi / 4.0, abs=1e-5)
    assert last.speed == pytest.approx(2.0, abs=1e-4)
    assert last.position_covariance == pytest.approx((0.04, 0, 0, 0, 0.09, 0, 0, 0, 0.16), abs=1e-9)
    assert last.velocity is None
    assert one.phases == [EndpointPhase.WAITING, EndpointPhase.STREAMING]


def test_given_nmea_at_the_wrong_rate_when_nothing_is_understood_then_the_next_rate_is_tried():
    settings = GpsSettings("gps", protocol="nmea", bauds=(4800, 9600))
    one = line(settings, NMEA_UNIT, device_baud=9600, baud=4800).run(5.0)
    assert one.baud == 9600
    assert one.samples
    assert "at 4800 baud" in one.reopens[0].reason


def test_given_no_fix_with_coordinates_in_bestpos_then_the_sample_has_none_and_keeps_them():
    (each,) = alone(position(status=1)).samples
    assert each.fix_type is FixType.NONE
    assert (each.latitude_deg, each.longitude_deg) == (50.0, -111.0)


def test_given_no_fix_and_zeros_in_bestpos_then_there_are_no_coordinates():
    empty = position(status=1, type=0, latitude=0.0, longitude=0.0, height=0.0, undulation=0.0)
    (each,) = alone(empty).samples
    assert each.fix_type is FixType.NONE
    assert all(map(math.isnan, (each.latitude_deg, each.longitude_deg, each.height_msl, each.height_ellipsoidal)))


def test_given_the_same_log_again_when_it_comes_then_it_is_not_published_again():
    one = alone(position(), position(), position(0.25))
    assert len(one.samples) == 2
    assert one.driver.counts["repeated"] == 1


def test_given_an_old_solution_stamped_again_when_it_comes_then_it_is_not_published_again():
    one = alone(position(), position(0.5, solution_age=0.5), position(1.0, solution_age=0.25))
    assert len(one.measured) == 2
    assert one.measured[1].delay == 0.25
    assert one.driver.counts["repeated"] == 1


@pytest.mark.parametrize(
    ("status", "known"),
    [
        (TimeStatus.UNKNOWN, False),
        (TimeStatus.APPROXIMATE, False),
        (TimeStatus.SATTIME, False),
        (TimeStatus.COARSE, True),
        (TimeStatus.FINESTEERING, True),
    ],
)
def test_given_a_time_status_when_the_time_is_not_good_then_there_is_no_device_time(status: TimeStatus, known: bool):
    (each,) = alone(position(time_status=status)).samples
    assert bool(each.header.device_utime) is known


def test_given_a_rolled_over_week_when_it_comes_then_the_time_is_of_these_days():
    log = position()
    body = bytearray(log[:-4])
    body[14:16] = (2288 - 1024).to_bytes(2, "little")
    (corrected,) = alone(bytes(body) + crc32(bytes(body)).to_bytes(4, "little")).samples
    (right,) = alone(log).samples
    assert corrected.header.device_utime == right.header.device_utime
    assert abs(right.header.device_utime - START) < 10 * SECOND


def test_given_logs_of_both_antennas_when_they_come_then_only_those_of_the_primary_are_used():
    body = Position(0, PositionType.SINGLE, 50.0, -111.0, 700.0, -20.0, 61, 1.0, 2.0, 3.0, "", 0.0, 0.0, 9, 8)
    sent = []
    for n in range(6):
        # the secondary antenna is logged in between, a meter away
        at = 252_818_000 + n * 500
        header = LogHeader("BESTPOS", 2288, at, TimeStatus.FINESTEERING, "COM1", 0, 0, True, n % 2)
        sent.append(encode(NovatelLog(header, body._replace(latitude=50.0 + (n % 2) * 1e-5))))
    driven = alone(*sent)
    assert {each.latitude_deg for each in driven.samples} == {50.0}
    assert len(driven.samples) == 3
    assert driven.driver.counts["rejected.secondary_antenna"] == 3
    assert sum("secondary antenna" in each for each in driven.status_text.splitlines()) == 1


@pytest.mark.parametrize("date", ["141123", "300304"])
def test_given_an_nmea_date_that_rolled_over_when_it_comes_then_the_time_is_of_these_days(date: str):
    fields = ("221320.00", "A", "5000.0", "N", "11100.0", "W", "1.0", "90.0", date, "", "", "A")
    (each,) = alone(nmea("GP", "RMC", fields), protocol="nmea").samples
    assert each.header.device_utime == START


def test_given_a_position_type_that_is_not_known_when_it_comes_then_it_is_no_fix_and_reported_once():
    one = alone(position(type=99), position(0.25, type=99))
    assert [each.fix_type for each in one.samples] == [FixType.NONE, FixType.NONE]
    assert one.status_text.count("position type") == 1


def test_given_an_emulated_receiver_that_is_replaced_when_it_greets_then_it_is_set_up_again():
    one = line().run(5.0)
    one.device = GpsEmulator(drive(30.0))
    one.from_device(one.device.on_open(one.now))
    one.run(3.0)
    assert one.driver.counts["restarts"] == 1
    assert one.device.counts["bestposb"] > 8


def test_given_another_datum_when_it_comes_then_it_is_rejected_and_reported_once():
    one = alone(*(position(n, datum=63) for n in range(4)))
    assert one.samples == []
    assert one.driver.counts["rejected.datum"] == 4
    assert one.status_text.count("not on WGS 84") == 1


def test_given_a_log_that_stands_alone_when_no_velocity_comes_then_it_is_published_after_a_while():
    one = alone()
    one.deliver(position())
    assert one.samples == []
    one.run(0.15)
    assert len(one.samples) == 1
    assert one.samples[0].velocity is None


def test_given_nmea_without_a_date_when_it_comes_then_the_day_is_the_hosts():
    fields = ("221320.00", "5000.00", "N", "11100.00", "W", "1", "05", "1.0", "700.0", "M", "-20.0", "M", "", "")
    one = alone(nmea("GP", "GGA", fields), protocol="nmea")
    (each,) = one.samples
    assert each.header.device_utime == START
    assert math.isnan(each.speed)


def test_given_a_driver_that_leaves_when_it_has_set_up_then_its_logs_are_stopped():
    one = line().run(3.0)
    one.from_driver(one.driver.on_close(one.now))
    assert tuple(one.device.logs) == ()


def test_given_samples_and_counts_when_compared_then_they_agree():
    one = line().run(5.0)
    assert one.driver.counts["samples"] == len(one.samples)
    assert one.driver.counts["novatel.BESTPOSB"] >= len(one.samples)
    assert one.device.counts["accepted"] == 3


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"protocol": "garmin"}, "protocol is one of novatel, nmea, got 'garmin'"),
        ({"rate_hz": 50.0}, "rate_hz is between 0.1 and 20, got 50"),
        ({"rate_hz": 0.2}, "silence is at least 1.5 periods, 7.5 s, got 2"),
        ({"commands": ("log\x00",)}, "is no line of text"),
        ({"bauds": (0,)}, "bauds are above 0"),
    ],
)
def test_given_a_setting_that_cannot_be_when_made_then_it_is_named(wrong: dict[str, object], expected: str):
    with pytest.raises(ValueError, match=expected):
        GpsSettings("gps", **wrong)  # type: ignore[arg-type]


def test_given_outputs_when_opened_then_the_first_word_is_waiting():
    outputs = GpsDriver(GpsSettings("gps", bauds=(9600,))).on_open(now_at(START))
    assert outputs[0] == EndpointStatus(EndpointPhase.WAITING, "waiting for NovAtel receiver")
    assert outputs[1] == Send(b"\r\nunlogall thisport\r\n")
    assert not any(isinstance(each, MeasuredSample) for each in outputs)


def test_given_a_wrong_device_that_keeps_talking_when_minutes_pass_then_the_words_do_not_pile_up():
    one = Line(GpsDriver(GpsSettings("gps", bauds=(9600, 115200))), GpsEmulator([]), is_broken=True).open()
    for n in range(1300):
        one.deliver(b"\x02noise %d\r\n" % n)
        one.run(0.1)
    assert 2 <= len([each for each in one.statuses if each.phase is EndpointPhase.SILENT]) <= 4, one.status_text
    assert len(one.reopens) > 20


def make_sentence(*sentences: str) -> bytes:
    return b"".join(nmea(each[:2], each[2:5], each.split(",")[1:]) for each in sentences)


GSV = make_sentence("GPGSV,1,1,00", "GPTXT,01,01,02,hello")
BARE = make_sentence("GPGGA,120000.00,5000.0,N,11100.0,W,1,08,0.9,700.0,M,-20.0,M,,").split(b"*")[0] + b"\r\n"
WRONG = make_sentence("GPGGA,120000.00,5000.0,N,11100.0,W,1,eight,0.9,700.0,M,-20.0,M,,")
STOPPED = make_sentence("GPGGA,120000.00,5000.0,N,11100.0,W,1,08,0.9,700.0,M,-20.0,M,,")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (GSV, ("nmea.unsupported", "are GGA or RMC on")),
        (BARE, ("rejected.nmea_incomplete", "with checksums")),
        (WRONG, ("rejected.nmea_field",)),
        (STOPPED, ("nmea.GPGGA", "does their time advance", "no new fix for 2 s")),
    ],
    ids=["others", "bare", "wrong", "still"],
)
def test_given_sentences_that_make_no_fix_when_received_then_the_reason_is_reported_and_the_rate_stays(
    data: bytes, expected: tuple[str, ...]
):
    one = alone(*[data] * 20, protocol="nmea", bauds=(4800, 9600))
    silent = [each.text for each in one.statuses if each.phase is EndpointPhase.SILENT]
    assert silent, one.status_text
    assert all(each in silent[0] for each in expected), silent[0]
    assert "baud" not in silent[0]
    assert not one.reopens


def test_given_a_heading_without_a_deviation_when_published_then_there_is_none():
    for sigma, known in ((0.0, False), (-1.0, False), (0.2, True)):
        heading = HeadingLog(0, 50, 2.0, 90.0, 1.0, sigma, 0.2, "AAAA", 10, 9)
        body = Position(0, PositionType.SINGLE, 50.0, -111.0, 700.0, -20.0, 61, 1.0, 2.0, 3.0, "", 0.0, 0.0, 9, 8)
        sample = sample_from_novatel(SensorHeader(1, "gps", 0), body, None, heading)
        assert sample.baseline_yaw == pytest.approx(0.0)
        assert (sample.baseline_yaw_sigma == sample.baseline_yaw_sigma) is known


def test_given_a_constant_delay_in_the_settings_when_published_then_it_goes_with_the_sample():
    one = line(GpsSettings("gps", delay=0.03, delay_sigma=0.005)).run(3.0)
    assert {(each.delay, each.delay_sigma) for each in one.measured} == {(0.03, 0.005)}


S = 1_000_000_000


@pytest.mark.parametrize(
    ("late_s", "first_is_lost"),
    [(0.2, False), (1.2, False), (1.8, False), (2.4, False), (0.2, True), (1.2, True), (1.8, True)],
)
def test_given_answers_that_come_late_or_not_when_set_up_then_each_is_its_own_commands(
    late_s: float, first_is_lost: bool
):
    commands = tuple(f"command {n}" for n in range(6))
    answered: list[tuple[str, str]] = []

    def ask() -> Script:
        for command in commands:
            error = yield RequestStep(command.encode(), 1.0, 3)
            answered.extend([(command, error)] if error else [])

    dialogue = ScriptRunner()
    coming: list[tuple[int, str]] = []
    now, sent = 0, 0

    def send(outputs: list[Output[bytes]]) -> None:
        nonlocal sent
        for each in outputs:
            assert isinstance(each, Send)
            if not (first_is_lost and sent == 0):
                coming.append((now + round(late_s * S), each.unit.decode()))
            sent += 1

    send(dialogue.start(ask(), HostTime(now, 0)))
    while dialogue.is_running:
        due = dialogue.deadline_ns
        assert due is not None
        if coming and coming[0][0] <= due:
            now, command = coming.pop(0)
            # every second command is refused, and expected which it was
            error = command if int(command[-1]) % 2 else ""
            send(dialogue.on_reply(error, HostTime(now, 0)))
        else:
            now = due
            send(dialogue.on_timer(HostTime(now, 0)))
    assert answered == [(each, each) for each in commands if int(each[-1]) % 2]
