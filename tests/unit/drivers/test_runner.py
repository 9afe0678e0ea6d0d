"""The runner on a scripted link and clock."""

from __future__ import annotations

import itertools
import logging
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import pytest

from modelserver.messages import DriverHealth, DriverPhase, ImuSample, Sample, SensorHeader, VehicleCommand
from msdrivers.endpoint import EndpointPhase, EndpointStatus, HostTime, MeasuredSample, Output, Reopen, Send
from msdrivers.links import EndOfRecordingError, LinkError
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.runner import Runner, RunnerSettings, SystemTimeSource

PERIOD_S = 0.1


@dataclass
class Echo:
    """A station that asks for data when the line opens, and takes every unit for a sample."""

    device_time: bool = False
    wake_ns: int | None = None
    extra: list[Output[bytes]] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)
    fails: Callable[[bytes], bool] = lambda unit: False
    seq: int = 0

    def on_open(self, now: HostTime) -> Sequence[Output[bytes]]:
        self.calls.append("opened")
        return [EndpointStatus(EndpointPhase.CONFIGURING, "asks"), Send(b"on")]

    def on_receive(self, unit: bytes, now: HostTime) -> Sequence[Output[bytes]]:
        if self.fails(unit):
            raise RuntimeError("a bug")
        self.seq += 1
        device = now.utime - 1_000_000 if self.device_time else 0
        header = SensorHeader(0, "imu", self.seq, now.utime, device)
        extra, self.extra = self.extra, []
        return [
            EndpointStatus(EndpointPhase.STREAMING, "comes"),
            MeasuredSample(ImuSample(header), 0.002, 0.001),
            *extra,
        ]

    def on_timer(self, now: HostTime) -> Sequence[Output[bytes]]:
        self.calls.append(f"on_timer {now.monotonic_ns}")
        self.wake_ns = None
        return [Send(b"poll")]

    def get_deadline(self) -> int | None:
        return self.wake_ns

    def on_close(self, now: HostTime) -> Sequence[Output[bytes]]:
        self.calls.append("leaving")
        return [Send(b"off")]

    def on_command(self, command: VehicleCommand, now: HostTime) -> Sequence[Output[bytes]]:
        return [Send(command.source.encode())]

    def reject_command(self, reason: str, text: str, now: HostTime) -> Sequence[Output[bytes]]:
        return [EndpointStatus(EndpointPhase.STREAMING, text, is_warning=True)]

    @property
    def counts(self) -> dict[str, int]:
        return {"messages": self.seq}


class Bench:
    """A runner with everything around it."""

    def __init__(self, seconds: float = 10.0, echo: Echo | None = None, **settings: float):
        self.time = FakeTimeSource(monotonic_ns=0)
        self.echo = echo or Echo()
        count = round(seconds / PERIOD_S)
        self.link: FakeLink[bytes] = FakeLink(self.time, [((n + 1) * PERIOD_S, b"x") for n in range(count)])
        self.samples: list[Sample] = []
        self.reports: list[DriverHealth] = []
        self.runner = Runner(
            self.echo,
            self.link,
            RunnerSettings("imu", "echo", **settings),  # type: ignore[arg-type]
            self.time,
            self.samples.append,
            self.reports.append,
            random.Random(1),
        )

    @property
    def now(self) -> float:
        return self.time.monotonic_ns * 1e-9

    def until(self, seconds: float) -> Bench:
        while self.now < seconds:
            self.runner.run_once()
        return self

    def phases(self) -> list[DriverPhase]:
        found: list[DriverPhase] = []
        for report in self.reports:
            if not found or found[-1] is not report.phase:
                found.append(report.phase)
        return found


def test_given_a_device_then_every_sample_is_published_and_none_twice() -> None:
    bench = Bench(5.0).until(5.05)
    assert [sample.header.seq for sample in bench.samples] == list(range(1, 51))
    assert [unit for _, unit in bench.link.sent] == [b"on"]
    assert bench.phases() == [DriverPhase.WAITING, DriverPhase.CONFIGURING, DriverPhase.STREAMING]


def test_given_no_device_time_then_the_stamp_is_the_receive_time_minus_the_delay() -> None:
    sample = Bench().until(0.25).samples[0]
    assert sample.header.utime == sample.header.host_utime - 2000
    assert sample.header.utime_sigma == 0.001


def test_given_device_time_then_the_stamp_is_on_the_hosts_clock_with_its_sigma() -> None:
    bench = Bench(echo=Echo(device_time=True)).until(8.0)
    header = bench.samples[-1].header
    assert abs(header.utime - (header.host_utime - 2000)) < 2000
    assert 1e-3 < header.utime_sigma < 3e-3
    health = bench.reports[-1]
    assert health.clock_offset == pytest.approx(1.0, abs=2e-3)
    assert health.clock_sigma == header.utime_sigma


def test_given_no_device_time_then_the_report_has_no_clock() -> None:
    assert math.isnan(Bench().until(2.0).reports[-1].clock_offset)


def test_given_a_second_then_a_report_goes_out_with_rate_and_counters() -> None:
    bench = Bench().until(4.5)
    regular = [report for report in bench.reports if report.phase is DriverPhase.STREAMING]
    assert len(regular) == 1 + 4
    assert regular[-1].rate_hz == pytest.approx(10.0, abs=1.0)
    assert regular[-1].counters == (("messages", regular[-1].samples),)
    assert (regular[-1].source, regular[-1].device, regular[-1].link) == ("imu", "echo", "fake")
    assert 0.0 <= regular[-1].age <= PERIOD_S + 1e-9


def test_given_a_station_that_is_due_then_its_timer_fires_then_and_not_before() -> None:
    bench = Bench(seconds=0.0)
    bench.until(0.01)
    bench.echo.wake_ns = 333_000_000
    bench.until(0.6)
    assert [call for call in bench.echo.calls if call.startswith("on_timer")] == ["on_timer 333000000"]
    assert bench.link.sent[-1] == (333_000_000, b"poll")


def test_given_a_device_unplugged_for_5_s_then_it_streams_within_2_s_of_its_return() -> None:
    bench = Bench(20.0)
    bench.link.outages = [(3.0, 8.0)]
    bench.until(12.0)
    seen = [sample.header.host_utime for sample in bench.samples]
    start = FakeTimeSource().utime_ns // 1000
    back = [(utime - start) * 1e-6 for utime in seen if utime > start + 3_000_000]
    assert 8.0 <= back[0] < 9.0
    assert bench.runner.reconnects == 1
    assert bench.phases()[-4:] == [
        DriverPhase.CLOSED,
        DriverPhase.WAITING,
        DriverPhase.CONFIGURING,
        DriverPhase.STREAMING,
    ]
    assert next(each for each in bench.reports if each.phase is DriverPhase.CLOSED).text.startswith("fake: it is away")


def test_given_a_port_that_is_never_there_then_it_is_tried_with_growing_waits_and_without_a_busy_loop() -> None:
    bench = Bench()
    bench.link.outages = [(0.0, math.inf)]
    tries: list[float] = []
    opened = bench.link.open

    def count_open(baud: int | None = None) -> None:
        tries.append(bench.now)
        opened(baud)

    bench.link.open = count_open  # type: ignore[method-assign]
    bench.until(20.0)
    waits = [after - before for before, after in itertools.pairwise(tries)]
    assert waits[0] == pytest.approx(0.2, rel=0.21)
    assert waits[1] == pytest.approx(0.4, rel=0.21)
    assert all(0.39 <= wait <= 0.61 for wait in waits[4:])
    assert len(set(waits[4:])) > 5  # jitter
    # a report a second, and one when it was first refused
    assert len(bench.reports) <= 22


def test_given_silence_then_it_is_reported_and_the_line_is_reopened() -> None:
    bench = Bench(2.0, reopen_timeout=6.0).until(15.0)
    silent = [report for report in bench.reports if report.phase is DriverPhase.SILENT]
    assert silent[0].text == "nothing received for 3 s"
    assert bench.echo.calls.count("opened") >= 2
    assert silent[0].age == pytest.approx(3.0, abs=0.2)


def test_given_a_device_that_speaks_again_then_it_is_silent_no_more() -> None:
    bench = Bench(2.0)
    bench.link.incoming.extend((6.0 + n * PERIOD_S, b"x") for n in range(20))
    bench.until(7.5)
    assert bench.phases()[-2:] == [DriverPhase.SILENT, DriverPhase.STREAMING]


def test_given_a_request_for_another_rate_then_the_line_is_opened_at_it_at_once() -> None:
    bench = Bench()
    bench.echo.extra = [Reopen("the device speaks faster", 115200), Send(b"never sent on the old line")]
    bench.until(0.5)
    assert bench.link.opened_bauds == [None, 115200]
    assert [unit for _, unit in bench.link.sent] == [b"on", b"on"]
    assert bench.link.baud == 115200
    # and what is lost later is opened at the same
    bench.link.outages = [(0.6, 0.7)]
    bench.until(2.0)
    assert bench.link.opened_bauds[-1] == 115200


def test_given_a_bug_in_a_station_then_it_is_counted_reported_and_the_driver_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    count = iter(range(1000))
    bench = Bench(5.0, echo=Echo(fails=lambda unit: next(count) % 2 == 0))
    with caplog.at_level(logging.ERROR):
        bench.until(5.05)
    assert len(bench.samples) == 25
    assert bench.runner.counts["errors.on_receive"] == 25
    assert dict(bench.runner.make_health(bench.time.now()).counters)["errors.on_receive"] == 25
    assert len([record for record in caplog.records if record.exc_info]) == 2  # the 1st and the 10th


def test_given_a_bus_that_fails_then_the_driver_goes_on() -> None:
    bench = Bench(1.0)

    def fails(sample: Sample) -> None:
        raise OSError("network is unreachable")

    bench.runner._publish = fails
    bench.until(1.05)
    assert bench.runner.samples == 0
    assert bench.runner.counts["errors.publish"] == 10


def test_given_the_order_to_end_then_the_device_is_left_and_the_line_closed() -> None:
    bench = Bench()
    bench.runner.run(lambda: bench.runner.stop() if bench.now > 2.0 else None)
    assert bench.echo.calls[-1] == "leaving"
    assert bench.link.sent[-1][1] == b"off"
    assert not bench.link.is_open
    assert (bench.reports[-1].phase, bench.reports[-1].text) == (DriverPhase.CLOSED, "ended")


def test_given_the_order_to_end_while_the_device_is_away_then_nothing_is_sent() -> None:
    bench = Bench()
    bench.link.outages = [(1.0, math.inf)]
    bench.runner.run(lambda: bench.runner.stop() if bench.now > 2.0 else None)
    assert "leaving" not in bench.echo.calls


def test_given_a_recording_that_ends_then_the_driver_ends_and_reports_it_once(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(1.0)
    poll = bench.link.poll

    def poll_to_end(timeout: float) -> Sequence[bytes]:
        if not bench.link.incoming:
            raise EndOfRecordingError("imu.raw", "the recording has ended; 3 damaged lines of it were left out")
        return poll(timeout)

    bench.link.poll = poll_to_end  # type: ignore[method-assign]
    with caplog.at_level(logging.INFO):
        bench.runner.run()
    assert len(bench.samples) == 10
    assert bench.reports[-1].text == "the recording has ended; 3 damaged lines of it were left out"
    messages = [(record.levelname, record.message) for record in caplog.records if "recording" in record.message]
    assert messages == [("INFO", "imu: closed: the recording has ended; 3 damaged lines of it were left out")]


def test_given_a_command_then_the_station_has_it_and_without_a_line_it_is_counted() -> None:
    bench = Bench()
    command = VehicleCommand(1, 0.5, 0, "operator", 1.0, 0.0)
    bench.runner.send_command(command)
    assert bench.runner.counts["commands_dropped"] == 1
    bench.until(0.5)
    bench.runner.send_command(command)
    assert bench.link.sent[-1][1] == b"operator"


def test_given_a_line_lost_while_sending_then_it_is_reopened() -> None:
    bench = Bench()
    send = bench.link.send
    left = iter([LinkError("fake", "gone"), None])

    def breaks(unit: bytes) -> None:
        error = next(left, None)
        if error is not None:
            raise error
        send(unit)

    bench.link.send = breaks  # type: ignore[method-assign]
    bench.until(1.0)
    assert bench.runner.reconnects == 1
    assert bench.samples


def test_given_the_time_of_day_steps_then_nothing_waits_for_it() -> None:
    bench = Bench(20.0, echo=Echo(device_time=True)).until(5.0)
    bench.time.utime_ns -= 3600 * 10**9
    bench.until(10.0)
    assert len(bench.samples) == pytest.approx(99, abs=2)
    assert bench.reports[-1].phase is DriverPhase.STREAMING


def test_given_an_interruption_between_the_clocks_then_both_are_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    ns = itertools.chain([0, 900_000, 901_000], itertools.count(902_000, 1_000))
    monkeypatch.setattr("msdrivers.runner.time.monotonic_ns", lambda: next(ns))
    monkeypatch.setattr("msdrivers.runner.time.time_ns", lambda: next(ns))
    now = SystemTimeSource().now()
    assert now.utime - now.monotonic_ns // 1000 <= 1
    assert now.monotonic_ns == 902_000


def test_given_an_interruption_at_each_reading_then_the_last_one_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    ns = itertools.count(0, 500_000)
    monkeypatch.setattr("msdrivers.runner.time.monotonic_ns", lambda: next(ns))
    monkeypatch.setattr("msdrivers.runner.time.time_ns", lambda: next(ns))
    assert SystemTimeSource().now() == HostTime(6_000_000, 6_500)
