from __future__ import annotations

from collections import Counter

import pytest
import support_stream_faults as faults

from modelserver.messages import RelativePoseSample
from modelserver.simulation import GpsModel, ImuModel, WheelsModel


@pytest.fixture
def events(simulate):
    run = simulate(gps_model=GpsModel(), imu_model=ImuModel(), wheels_model=WheelsModel(), odometry_frame="Car:Camera")
    return list(run.events(30.0))


def key(event):
    return (event.header.source, event.header.seq)


def arrivals(events):
    return [event.header.host_utime for event in events]


FAULTS = {
    "late": lambda events, seed: faults.delay(events, seed, "imu", 0.2, 0.5),
    "duplicate": lambda events, seed: faults.duplicate(events, seed, 0.3, max_delay=0.1),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS.values(), ids=list(FAULTS))
def test_the_seed_decides_and_the_samples_given_stay_as_they_were(events, fault):
    before = list(map(repr, events))
    one, same, other = (list(map(repr, fault(events, seed))) for seed in (1, 1, 2))
    assert one == same
    assert one != other
    assert one != before
    assert list(map(repr, events)) == before


def test_delayed_samples_keep_their_utime_and_come_in_order_of_arrival(events):
    late = list(faults.delay(events, 1, "imu", 0.2, min_delay=0.05))
    assert arrivals(late) == sorted(arrivals(late))
    was = {key(event): event.header for event in events}
    assert sorted(map(key, late)) == sorted(was)
    for event in late:
        old = was[key(event)]
        assert event.header.utime == old.utime
        delay = (event.header.host_utime - old.host_utime) * 1e-6
        if event.header.source != "imu":
            assert delay == 0.0
        else:
            assert 0.05 - 1e-6 <= delay <= 0.2 + 1e-6
    seqs = [event.header.seq for event in late if event.header.source == "imu"]
    assert seqs != sorted(seqs)
    with pytest.raises(ValueError, match="delay"):
        list(faults.delay(events, 1, "imu", -0.1))


def test_a_stream_without_end_is_served_as_it_comes(simulate):
    run = simulate(imu_model=ImuModel())
    endless = run.events(1e9)
    late = faults.delay(faults.duplicate(endless, 2, 0.1, max_delay=0.05), 1, "imu", 0.2)
    assert len([next(late) for _ in range(100)]) == 100


def test_duplicates_are_the_same_sample_again(events):
    twice = list(faults.duplicate(events, 1, 0.2, "gps", max_delay=0.3))
    assert arrivals(twice) == sorted(arrivals(twice))
    count = Counter(map(key, twice))
    assert {name for (name, _), times in count.items() if times == 2} == {"gps"}
    assert max(count.values()) == 2
    first = {}
    for event in twice:
        one = first.setdefault(key(event), event)
        assert event.header.utime == one.header.utime
        assert 0 <= event.header.host_utime - one.header.host_utime <= 300_000


def test_the_computers_clock_steps_back(events):
    at = events[0].header.utime + 10_000_000
    stepped = list(faults.step_clock_back(events, at, 5.0))
    assert list(map(key, stepped)) == list(map(key, events))
    for event, old in zip(stepped, events, strict=True):
        assert old.header.utime - event.header.utime == (5_000_000 if old.header.utime >= at else 0)
        assert old.header.host_utime - event.header.host_utime == (5_000_000 if old.header.host_utime >= at else 0)
        assert event.header.device_utime == old.header.device_utime
        if isinstance(old, RelativePoseSample):
            assert old.since_utime - event.since_utime == (5_000_000 if old.since_utime >= at else 0)


def test_one_sources_stamps_step_alone(events):
    at = events[0].header.utime + 10_000_000
    for event, old in zip(faults.step_clock_back(events, at, -2.0, "gps"), events, strict=True):
        assert event.header.host_utime == old.header.host_utime
        moved = event.header.utime - old.header.utime
        assert moved == (2_000_000 if old.header.source == "gps" and old.header.utime >= at else 0)
