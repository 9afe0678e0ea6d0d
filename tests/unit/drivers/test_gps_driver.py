"""The driver of a satellite receiver against the receiver in software, and against what is no receiver."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from support_gps import SECOND, START, Line, drive, halves, noisy, now_at

from modelserver.messages import FixType, SensorHeader
from msdrivers.devices.gps import GpsDriver, GpsSettings
from msdrivers.devices.gps.samples import novatel_sample
from msdrivers.devices.gps.set_up import SetUp, SetupProgress
from msdrivers.emulate.gps import GpsEmulator, GpsUnit
from msdrivers.protocol.nmea.encode import encode as nmea
from msdrivers.protocol.novatel import Answer, HeadingLog, LogHeader, NovatelLog, Position, PositionType, TimeStatus
from msdrivers.protocol.novatel.crc import crc32
from msdrivers.protocol.novatel.encode import encode
from msdrivers.station import Measured, Send, StationPhase, StationStatus

NMEA_UNIT = GpsUnit(
    saved=tuple(f"log com1 {name} ontime 0.25" for name in ("gpgga", "gpgsa", "gpgst", "gprmc")), answers=False
)


def line(settings: GpsSettings | None = None, unit: GpsUnit | None = None, seconds: float = 30.0, **more) -> Line:
    driver = GpsDriver(settings or GpsSettings("gps"))
    return Line(driver, GpsEmulator(drive(seconds), unit), **more).open()


def position(utime_s: float = 0.0, **changes) -> bytes:
    """A BESTPOS log, `utime_s` after 2023-11-14 22:13:38 GPS."""
    status = changes.pop("time_status", TimeStatus.FINESTEERING)
    header = LogHeader("BESTPOS", 2288, 252_818_000 + round(utime_s * 1000), status, "COM1", 0, 0, True)
    body = Position(0, PositionType.SINGLE, 50.0, -111.0, 700.0, -20.0, 61, 1.0, 2.0, 3.0, "", 0.0, 0.0, 9, 8)
    return encode(NovatelLog(header, body._replace(**changes)))


def alone(*data: bytes, **settings) -> Line:
    """A driver that hears some bytes, each chunk half a second later, from nobody that answers."""
    one = Line(GpsDriver(GpsSettings("gps", **settings)), GpsEmulator([], GpsUnit(answers=False))).open()
    for chunk in data:
        one.hear(chunk)
        one.run(0.5)
    return one


@pytest.mark.parametrize("log_format", ["binary", "ascii"])
@pytest.mark.parametrize("rate", [4.0, 10.0, 20.0])
def test_given_a_receiver_when_set_up_then_every_fix_comes_with_its_velocity(rate: float, log_format: str):
    one = line(GpsSettings("gps", rate_hz=rate, log_format=log_format)).run(5.0)
    assert one.phases == [StationPhase.WAITING, StationPhase.CONFIGURING, StationPhase.STREAMING], one.words
    assert abs(len(one.samples) - 5.0 * rate) <= 2
    assert one.device.logs == tuple(f"best{what}{log_format[0]}" for what in ("pos", "vel"))
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
    one = line(unit=GpsUnit(boot=1.5)).run(5.0)
    one.from_device(one.device.restart(one.now))
    before = len(one.samples)
    one.run(1.0)
    assert len(one.samples) == before
    one.run(4.0)
    assert one.device.counts["restarts"] == 1
    assert one.driver.counts["restarts"] == 1
    assert len(one.samples) - before > 10
    assert one.phases[-2:] == [StationPhase.CONFIGURING, StationPhase.STREAMING], one.words
    assert "started anew" in one.words


def test_given_a_restart_without_a_prompt_when_the_logs_stay_away_then_the_receiver_is_set_up_again():
    one = line(unit=GpsUnit(boot=4.0)).run(5.0)
    one.from_device(one.device.restart(one.now))
    one.dead = True
    one.run(4.5)  # the prompt is lost
    one.dead = False
    before = len(one.samples)
    one.run(6.0)
    assert len(one.samples) - before > 8, one.words
    assert StationPhase.SILENT in one.phases
    assert "no BESTPOS for 2 s" in one.words


def test_given_noise_and_half_packets_when_streaming_then_only_what_was_said_is_published():
    shake = noisy(7)
    one = line(to_host=lambda data: [half for part in shake(data) for half in halves(part)]).run(25.0)
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
    one = line(GpsSettings("gps", bauds=bauds), unit, right_baud=9600, baud=bauds[0]).run(12.0)
    assert one.baud == 9600, one.words
    assert one.phases[-1] is StationPhase.STREAMING
    assert len(one.reopened) == bauds.index(9600)


def test_given_a_wrong_device_when_all_rates_are_tried_then_it_says_what_was_heard_and_tried():
    driver = GpsDriver(GpsSettings("gps", bauds=(9600, 115200)))
    one = Line(driver, GpsEmulator([]), dead=True).open()
    for _ in range(100):
        one.hear(b"\x02LMS200 \x80\x81\x00\x03")
        one.run(0.1)
    silent = [each.text for each in one.told if each.phase is StationPhase.SILENT]
    assert silent
    assert "no NovAtel receiver" in silent[0]
    assert "at 9600 baud heard" in silent[0]
    assert "at 115200 baud heard" in silent[0]
    assert "LMS200" in silent[0]
    assert "another device" in silent[0]
    assert not one.samples
    assert [each.baud for each in one.reopened[:3]] == [115200, 9600, 115200]


def test_given_a_dead_line_when_nothing_is_heard_then_power_and_cable_are_named():
    one = line(dead=True).run(5.0)
    assert "heard nothing; check the receiver's power, the cable" in one.words
    assert len(one.told) < 6, one.words


def test_given_a_refused_command_when_set_up_then_the_words_of_the_receiver_are_told():
    one = line(GpsSettings("gps", commands=("frobnicate 1",))).run(3.0)
    assert "refused 'frobnicate 1': Invalid Message. Field = frobnicate" in one.words
    assert one.phases[-1] is StationPhase.STREAMING
    assert one.samples


def test_given_a_receiver_that_cannot_hear_when_it_sends_then_its_fixes_are_used_and_it_is_told():
    unit = GpsUnit(saved=("log com1 bestposb ontime 0.25",), answers=False)
    one = line(unit=unit).run(8.0)
    assert len(one.samples) > 28
    assert "does not answer commands" in one.words
    assert len(one.told) < 6, one.words


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
    assert one.phases == [StationPhase.WAITING, StationPhase.STREAMING]


def test_given_nmea_at_the_wrong_rate_when_nothing_is_understood_then_the_next_rate_is_tried():
    settings = GpsSettings("gps", protocol="nmea", bauds=(4800, 9600))
    one = line(settings, NMEA_UNIT, right_baud=9600, baud=4800).run(5.0)
    assert one.baud == 9600
    assert one.samples
    assert "at 4800 baud" in one.reopened[0].why


def test_given_no_fix_with_coordinates_when_bestpos_says_so_then_the_sample_says_none_and_keeps_them():
    (each,) = alone(position(status=1)).samples
    assert each.fix_type is FixType.NONE
    assert (each.latitude_deg, each.longitude_deg) == (50.0, -111.0)


def test_given_no_fix_and_zeros_when_bestpos_says_so_then_there_are_no_coordinates():
    empty = position(status=1, type=0, latitude=0.0, longitude=0.0, height=0.0, undulation=0.0)
    (each,) = alone(empty).samples
    assert each.fix_type is FixType.NONE
    assert all(map(math.isnan, (each.latitude_deg, each.longitude_deg, each.height_msl, each.height_ellipsoidal)))


def test_given_the_same_log_again_when_it_comes_then_it_is_not_published_again():
    one = alone(position(), position(), position(0.25))
    assert len(one.samples) == 2
    assert one.driver.counts["repeated"] == 1


def test_given_an_old_solution_stamped_anew_when_it_comes_then_it_is_not_published_again():
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
    (mended,) = alone(bytes(body) + crc32(bytes(body)).to_bytes(4, "little")).samples
    (right,) = alone(log).samples
    assert mended.header.device_utime == right.header.device_utime
    assert abs(right.header.device_utime - START) < 10 * SECOND


@pytest.mark.parametrize("binary", [True, False])
def test_given_logs_of_both_antennas_when_they_come_then_only_those_of_the_primary_are_used(binary: bool):
    body = Position(0, PositionType.SINGLE, 50.0, -111.0, 700.0, -20.0, 61, 1.0, 2.0, 3.0, "", 0.0, 0.0, 9, 8)
    sent = []
    for n in range(6):
        # the secondary antenna is logged in between, a metre away
        at = 252_818_000 + n * 500
        header = LogHeader("BESTPOS", 2288, at, TimeStatus.FINESTEERING, "COM1", 0, 0, binary, n % 2)
        sent.append(encode(NovatelLog(header, body._replace(latitude=50.0 + (n % 2) * 1e-5))))
    driven = alone(*sent)
    assert {each.latitude_deg for each in driven.samples} == {50.0}
    assert len(driven.samples) == 3
    assert driven.driver.counts["rejected.secondary_antenna"] == 3
    assert sum("secondary antenna" in each for each in driven.words.splitlines()) == 1


def test_given_a_leap_second_when_it_comes_then_the_fix_is_published_without_a_device_time():
    # week 1930, 18 s is 2017-01-01 00:00:00 UTC
    body = Position(0, PositionType.SINGLE, 50.0, -111.0, 700.0, -20.0, 61, 1.0, 2.0, 3.0, "", 0.0, 0.0, 9, 8)
    headers = (
        LogHeader("BESTPOS", 1930, ms, TimeStatus.FINESTEERING, "COM1", 0, 0, True) for ms in (16_500, 17_500, 18_500)
    )
    before, within, after = alone(*(encode(NovatelLog(header, body)) for header in headers)).samples
    assert after.header.device_utime - before.header.device_utime == SECOND
    assert within.header.device_utime == 0


@pytest.mark.parametrize("date", ["141123", "300304"])
def test_given_an_nmea_date_that_rolled_over_when_it_comes_then_the_time_is_of_these_days(date: str):
    said = ("221320.00", "A", "5000.0", "N", "11100.0", "W", "1.0", "90.0", date, "", "", "A")
    (each,) = alone(nmea("GP", "RMC", said), protocol="nmea").samples
    assert each.header.device_utime == START


def test_given_a_position_type_that_is_not_known_when_it_comes_then_it_is_no_fix_and_told_once():
    one = alone(position(type=99), position(0.25, type=99))
    assert [each.fix_type for each in one.samples] == [FixType.NONE, FixType.NONE]
    assert one.words.count("position type") == 1


def test_given_an_emulated_receiver_that_is_made_anew_when_it_greets_then_it_is_set_up_again():
    one = line().run(5.0)
    one.device = GpsEmulator(drive(30.0))
    one.from_device(one.device.opened(one.now))
    one.run(3.0)
    assert one.driver.counts["restarts"] == 1
    assert one.device.counts["bestposb"] > 8


def test_given_another_datum_when_it_comes_then_it_is_refused_and_told_once():
    one = alone(*(position(n, datum=63) for n in range(4)))
    assert one.samples == []
    assert one.driver.counts["rejected.datum"] == 4
    assert one.words.count("not on WGS 84") == 1


def test_given_a_log_that_stands_alone_when_no_velocity_comes_then_it_is_published_after_a_while():
    one = alone()
    one.hear(position())
    assert one.samples == []
    one.run(0.15)
    assert len(one.samples) == 1
    assert one.samples[0].velocity is None


def test_given_nmea_without_a_date_when_it_comes_then_the_host_tells_the_day():
    said = ("221320.00", "5000.00", "N", "11100.00", "W", "1", "05", "1.0", "700.0", "M", "-20.0", "M", "", "")
    one = alone(nmea("GP", "GGA", said), protocol="nmea")
    (each,) = one.samples
    assert each.header.device_utime == START
    assert math.isnan(each.speed)


def test_given_a_driver_that_leaves_when_it_has_set_up_then_its_logs_are_stopped():
    one = line().run(3.0)
    one.from_driver(one.driver.leaving(one.now))
    assert one.device.logs == ()
    kept = GpsDriver(GpsSettings("gps", restore_on_leaving=False))
    assert list(kept.leaving(now_at(START))) == []


def test_given_samples_and_counts_when_compared_then_they_agree():
    one = line().run(5.0)
    assert one.driver.counts["samples"] == len(one.samples)
    assert one.driver.counts["novatel.BESTPOSB"] >= len(one.samples)
    assert one.device.counts["accepted"] == 3


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"protocol": "garmin"}, "protocol: must be one of novatel, nmea, got 'garmin'"),
        ({"rate_hz": 50.0}, "rate_hz: must be 0.1 to 20 Hz"),
        ({"rate_hz": 0.2}, "silence: 2 s is less than one and a half periods"),
        ({"commands": ("log\x00",)}, "is no line of text"),
        ({"bauds": (0,)}, "bauds: must be above 0"),
        ({"answer": math.nan}, "answer: must be"),
    ],
)
def test_given_a_setting_that_cannot_be_when_made_then_it_is_named(wrong: dict[str, object], says: str):
    with pytest.raises(ValueError, match=says):
        GpsSettings("gps", **wrong)  # type: ignore[arg-type]


def test_given_outputs_when_opened_then_the_first_word_is_waiting():
    outputs = GpsDriver(GpsSettings("gps", bauds=(9600,))).opened(now_at(START))
    assert outputs[0] == StationStatus(StationPhase.WAITING, "listening for a receiver at 9600 baud")
    assert outputs[1] == Send(b"\r\nunlogall thisport\r\n")
    assert not any(isinstance(each, Measured) for each in outputs)


def test_given_a_wrong_device_that_keeps_talking_when_minutes_pass_then_the_words_do_not_pile_up():
    one = Line(GpsDriver(GpsSettings("gps", bauds=(9600, 115200))), GpsEmulator([]), dead=True).open()
    for n in range(1300):
        one.hear(b"\x02noise %d\r\n" % n)
        one.run(0.1)
    assert 2 <= len([each for each in one.told if each.phase is StationPhase.SILENT]) <= 4, one.words
    assert len(one.reopened) > 20


def spoken(*sentences: str) -> bytes:
    return b"".join(nmea(each[:2], each[2:5], each.split(",")[1:]) for each in sentences)


GSV = spoken("GPGSV,1,1,00", "GPTXT,01,01,02,hello")
BARE = spoken("GPGGA,120000.00,5000.0,N,11100.0,W,1,08,0.9,700.0,M,-20.0,M,,").split(b"*")[0] + b"\r\n"
WRONG = spoken("GPGGA,120000.00,5000.0,N,11100.0,W,1,eight,0.9,700.0,M,-20.0,M,,")
STILL = spoken("GPGGA,120000.00,5000.0,N,11100.0,W,1,08,0.9,700.0,M,-20.0,M,,")


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (GSV, ("heard GPGSV, GPTXT, which are not used since", "switch GGA or RMC on")),
        (BARE, ("heard GPGGA without checksum since", "switch its checksums on")),
        (WRONG, ("heard GPGGA with a right checksum and a field that cannot be", "compare its sentences")),
        (STILL, ("GPGGA come, but their time stands still", "no new fix for 2 s")),
    ],
    ids=["others", "bare", "wrong", "still"],
)
def test_given_sentences_that_make_no_fix_when_heard_then_it_is_said_why_and_the_rate_is_kept(
    data: bytes, says: tuple[str, ...]
):
    one = alone(*[data] * 20, protocol="nmea", bauds=(4800, 9600))
    silent = [each.text for each in one.told if each.phase is StationPhase.SILENT]
    assert silent, one.words
    assert all(each in silent[0] for each in says), silent[0]
    assert "baud" not in silent[0]
    assert not one.reopened


def test_given_a_heading_without_a_deviation_when_published_then_there_is_none():
    for sigma, known in ((0.0, False), (-1.0, False), (0.2, True)):
        heading = HeadingLog(0, 50, 2.0, 90.0, 1.0, sigma, 0.2, "AAAA", 10, 9)
        body = Position(0, PositionType.SINGLE, 50.0, -111.0, 700.0, -20.0, 61, 1.0, 2.0, 3.0, "", 0.0, 0.0, 9, 8)
        sample = novatel_sample(SensorHeader(1, "gps", 0), body, None, heading)
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
    dialogue = SetUp(commands, S, 3)
    coming: list[tuple[int, str]] = []
    answered: list[tuple[str, str]] = []
    now, sent = 0, 0

    def send(data: bytes) -> None:
        nonlocal sent
        for each in data.decode().split("\r\n"):
            if each and not (first_is_lost and sent == 0):
                coming.append((now + round(late_s * S), each))
            sent += bool(each)

    send(dialogue.begin(now))
    while dialogue.progress is SetupProgress.ASKING:
        due = dialogue.due()
        assert due is not None
        if coming and coming[0][0] <= due:
            now, command = coming.pop(0)
            # every second command is refused, and says which it was
            error = command if int(command[-1]) % 2 else ""
            send(dialogue.answered(Answer(0, error), now))
        else:
            now = due
            send(dialogue.woken(now))
    answered = dialogue.refused
    assert dialogue.progress is SetupProgress.DONE
    assert answered == [(each, each) for each in commands if int(each[-1]) % 2]
