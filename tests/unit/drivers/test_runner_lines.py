"""The runner on links that are lost repeatedly, raise other exceptions or are silent, and its reports."""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import pytest
from support_vehicle_bus import axis_settings, raptor_dbc, wheels_settings
from test_runner import PERIOD_S, Bench, Echo

from modelserver.messages import DriverPhase, VehicleCommand
from msdrivers.devices.axis import AxisDriver
from msdrivers.devices.gps.driver import GpsDriver, GpsSettings
from msdrivers.devices.wheels import WheelsDriver
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, Output, Reopen, Send
from msdrivers.links import LinkError


@dataclass
class Rare(Echo):
    """A station of a device that may be quiet for long."""

    max_silence: float = math.inf


@dataclass
class Broken(Echo):
    """A station that finds its line unusable with the first unit."""

    opened_at: list[float] = field(default_factory=list)

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        self.opened_at.append(now.monotonic_ns * 1e-9)
        return [EndpointStatus(EndpointPhase.WAITING, "asks"), Send(b"on")]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        return [EndpointStatus(EndpointPhase.SILENT, "that is no answer"), Reopen("that is no answer")]


def answering(bench: Bench) -> None:
    """Let every request be answered at once."""
    send = bench.link.send

    def answers(unit: bytes) -> None:
        send(unit)
        bench.link.incoming.clear()
        bench.link.incoming.append((bench.now + 0.001, b"x"))

    bench.link.send = answers  # type: ignore[method-assign]


# --- quiet -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quiet", [math.inf, 60.0])
def test_given_a_device_that_may_be_quiet_then_its_line_stays_open_and_no_silence_is_reported(quiet: float) -> None:
    bench = Bench(0.0, echo=Rare(max_silence=quiet)).until(50.0)
    assert bench.link.opened_bauds == [None]
    assert DriverPhase.SILENT not in bench.phases()


def test_given_a_device_that_is_quiet_longer_than_it_may_be_then_the_line_is_reopened() -> None:
    bench = Bench(0.0, echo=Rare(max_silence=20.0)).until(45.0)
    assert bench.link.opened_bauds == [None, None]
    assert next(each.text for each in bench.reports if each.phase is DriverPhase.SILENT) == "nothing received for 20 s"


def test_given_the_stations_of_devices_then_those_that_may_be_quiet_report_for_how_long() -> None:
    rare = GpsDriver(GpsSettings("gps", rate_hz=0.1, silence=20.0))
    axis = AxisDriver(axis_settings(silence=30.0))
    wheels = WheelsDriver(wheels_settings(silence=60.0), raptor_dbc())
    assert [station.max_silence for station in (rare, axis, wheels)] == [
        20.0,
        30.0,
        60.0,
    ]


# --- errors that are no LinkError --------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["open", "poll", "send"])
def test_given_a_line_that_fails_in_its_own_way_then_it_is_counted_reported_and_tried_again(
    what: str, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(20.0)
    ask = getattr(bench.link, what)
    fails = iter([True, True])

    def raises(*arguments: object) -> object:
        if next(fails, False):
            raise TypeError("of a library")
        return ask(*arguments)

    setattr(bench.link, what, raises)
    with caplog.at_level(logging.ERROR):
        bench.until(3.0)
    assert bench.runner.counts[f"errors.link.{what}"] == 2
    assert bench.samples
    assert len([record for record in caplog.records if record.exc_info]) == 1
    closed = next(each for each in bench.reports if each.phase is DriverPhase.CLOSED)
    assert closed.text.startswith("fake: TypeError: 'of a library'")


def test_given_a_line_that_cannot_be_closed_then_the_driver_goes_on() -> None:
    bench = Bench(20.0)

    def raises() -> None:
        raise NameError("of a library")

    bench.link.close = raises  # type: ignore[method-assign]
    bench.link.outages = [(1.0, 1.5)]
    bench.runner.run(lambda: bench.runner.stop() if bench.now > 4.0 else None)
    assert bench.runner.counts["errors.link.close"] == 3
    assert bench.reports[-1].text == "ended"


# --- lines that go and come --------------------------------------------------------------------------------------


def test_given_a_line_that_is_unusable_at_each_opening_then_it_is_tried_with_growing_waits() -> None:
    echo = Broken()
    bench = Bench(0.0, echo=echo)
    answering(bench)
    bench.until(20.0)
    waits = [after - before for before, after in itertools.pairwise(echo.opened_at)]
    assert all(0.39 <= wait <= 0.61 for wait in waits[4:])
    assert len(bench.reports) < 200


def test_given_a_flood_of_words_then_reports_and_log_are_few_and_the_last_is_reported(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bench = Bench(0.0).until(0.1)
    bench.link.incoming.extend((0.1 + 0.001 * n, b"x") for n in range(3000))
    words = iter(range(10_000))
    received = bench.echo.on_receive

    def talks(unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        return [*received(unit, now), EndpointStatus(EndpointPhase.STREAMING, f"word {next(words)}")]

    bench.echo.on_receive = talks  # type: ignore[method-assign]
    with caplog.at_level(logging.INFO):
        bench.until(5.0)
    assert len(bench.reports) < 60
    assert len(caplog.records) < 60
    assert bench.reports[-1].text == "word 2999"


def flapping(bench: Bench, seconds: float) -> None:
    """Let another program take the line so long after each opening."""
    opened = bench.link.open

    def opens(baud: int | None = None) -> None:
        opened(baud)
        bench.link.outages = [(bench.now + seconds, bench.now + seconds + 0.01)]

    bench.link.open = opens  # type: ignore[method-assign]


def test_given_a_line_that_is_repeatedly_lost_then_that_is_reported_and_the_log_is_not_filled(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bench = Bench(60.0)
    flapping(bench, 0.25)
    with caplog.at_level(logging.INFO):
        bench.until(60.0)
    assert bench.runner.reconnects > 60
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) < 20
    assert any("it is opened and closed again and again: does another program use it?" in each for each in messages)
    closed = [each.text for each in bench.reports if each.phase is DriverPhase.CLOSED]
    assert closed[-1].endswith("does another program use it?")


def test_given_a_line_that_is_steady_again_then_its_states_are_logged_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bench = Bench(100.0)
    opened = bench.link.open
    flapping(bench, 0.25)
    bench.until(10.0)
    bench.link.open = opened  # type: ignore[method-assign]
    assert collect_log(caplog, lambda: bench.until(80.0)) == [("INFO", "imu: streaming: comes")]
    bench.link.outages = [(bench.now, bench.now + 0.1)]
    messages = [text for _, text in collect_log(caplog, lambda: bench.until(90.0))]
    assert len(messages) == 4
    assert messages[0] == "imu: closed: fake: it is away; waiting for its return"


# --- warnings ---------------------------------------------------------------------------------------------


def collect_log(caplog: pytest.LogCaptureFixture, do: Callable[[], object]) -> list[tuple[str, str]]:
    caplog.clear()
    with caplog.at_level(logging.INFO):
        do()
    return [(record.levelname, record.getMessage()) for record in caplog.records]


def test_given_a_warning_then_it_is_a_warning_and_stands_beside_the_silence_that_follows(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bench = Bench(0.5)
    bench.echo.extra = [EndpointStatus(EndpointPhase.CONFIGURING, "the device refuses 'log'", is_warning=True)]
    bench.echo.fails = lambda unit: bench.echo.seq > 0
    messages = collect_log(caplog, lambda: bench.until(5.0))
    assert ("WARNING", "imu: configuring: the device refuses 'log'") in messages
    silent = ("WARNING", "imu: silent: nothing received for 3 s; before that: the device refuses 'log'")
    assert messages[-1] == silent


def test_given_a_warning_that_is_over_then_a_later_silence_does_not_name_it(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(1.0)
    bench.echo.extra = [EndpointStatus(EndpointPhase.STREAMING, "a speed that cannot be", is_warning=True)]
    messages = collect_log(caplog, lambda: bench.until(1.0 + PERIOD_S))
    assert ("WARNING", "imu: streaming: a speed that cannot be") in messages
    messages = collect_log(caplog, lambda: bench.until(5.0))
    assert messages[-1] == ("WARNING", "imu: silent: nothing received for 3 s")


@pytest.mark.parametrize(("seconds", "first_warning"), [(2.0, math.inf), (20.0, 5.0)])
def test_given_a_device_that_appears_after_its_driver_then_only_a_lasting_absence_is_a_warning(
    caplog: pytest.LogCaptureFixture, seconds: float, first_warning: float
) -> None:
    bench = Bench()
    bench.link.outages = [(0.0, seconds)]
    at = math.inf
    while bench.now < 8.0 and not math.isfinite(at):
        messages = collect_log(caplog, lambda: bench.until(bench.now + 0.5))
        at = bench.now if any(level == "WARNING" and "closed" in text for level, text in messages) else at
    assert at == pytest.approx(first_warning, abs=1.6)


def test_given_bytes_that_are_no_command_then_the_endpoint_reports_it_as_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    bench = Bench().until(0.5)
    messages = collect_log(caplog, lambda: bench.runner.reject_command("malformed", "a command refused: valid_for -1"))
    assert messages == [("WARNING", "imu: streaming: a command refused: valid_for -1")]
    bench.link.outages = [(0.6, math.inf)]
    bench.until(1.0)
    bench.runner.reject_command("malformed", "a command refused")
    bench.runner.send_command(VehicleCommand(1, 0.5, 0, "operator", 1.0, 0.0))
    assert bench.runner.counts["commands_dropped"] == 2


def test_given_a_line_that_is_not_there_then_no_other_program_is_suspected() -> None:
    bench = Bench()
    bench.link.outages = [(0.0, math.inf)]
    bench.until(20.0)
    assert not [each for each in bench.reports if "another program" in each.text]
    with pytest.raises(LinkError):
        bench.link.open()
