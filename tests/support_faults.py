"""False data from sensors: each fault once, for the real daemon and for the core at full speed."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import support_stream_faults as faults

from benchmarks.rough_simulation import EncoderModel
from modelserver.messages import ImuSample
from modelserver.simulation import Event, GpsModel, ImuModel, Timing, WheelsModel

FROM_S = 10.0
"""When a fault begins, seconds since the drive did."""

Transform = Callable[[Iterable[Event], int], Iterable[Event]]
"""Takes samples in the order of their arrival and the utime of the start; gives them as they arrive with the fault."""

NAN = (math.nan,) * 3


@dataclass(frozen=True)
class Fault:
    """A fault: of the sensors' `models`, or on the way (`transform`). `counted`: what health must show for it.

    `stays_valid`: whether the pose stays valid all the while; else it is not valid as long as the fault lasts.
    """

    models: Mapping[str, Any] = field(default_factory=dict)
    transform: Transform = lambda events, begin: events
    counted: frozenset[tuple[str, str]] = frozenset()
    stays_valid: bool = True


def clock_off(seconds: float) -> Transform:
    """The receiver's stamps are off by so much from the start of the fault on; its fixes come as before."""

    def transform(events: Iterable[Event], begin: int) -> Iterator[Event]:
        return faults.step_clock_back(events, begin + round(FROM_S * 1e6), -seconds, "gps")

    return transform


def without_numbers(events: Iterable[Event], begin: int) -> Iterator[Event]:
    """The inertial unit publishes nan."""
    for event in events:
        if isinstance(event, ImuSample) and event.header.utime >= begin + FROM_S * 1e6:
            event = replace(event, angular_velocity=NAN, specific_force=NAN)
        yield event


def twice_and_mixed(events: Iterable[Event], begin: int) -> Iterator[Event]:
    """All sensors' messages overtake each other by 0.1 s, and three in ten come again within 0.2 s."""
    return faults.duplicate(faults.delay(events, 3, None, 0.1), 4, 0.3, max_delay=0.2)


def loop_log(events: Iterable[Event], begin: int) -> Iterator[Event]:
    """The log of the first seconds comes again, stamps and all, while the drive goes on."""
    every = list(events)
    shift = round(FROM_S * 1e6)
    again = [
        replace(each, header=replace(each.header, host_utime=each.header.host_utime + shift))
        for each in every
        if each.header.host_utime < begin + shift
    ]
    return heapq.merge(every, again, key=lambda each: each.header.host_utime)


def _stuck(*wheels: str) -> dict[str, Any]:
    return {"wheels_model": WheelsModel(encoder=EncoderModel(stuck=tuple((wheel, FROM_S) for wheel in wheels)))}


INERTIAL = ImuModel(Timing(50.0, latency=0.004, jitter=0.001))
"""Half of the usual rate: the same drive in less time."""


FAULTS = {
    "gps_jumps_700_m": Fault(
        {"gps_model": GpsModel(jumps=((FROM_S, FROM_S + 10.0, 500.0, 490.0),))},
        counted=frozenset({("sensor:gps", "gate")}),
    ),
    "gps_1_s_ahead": Fault(transform=clock_off(1.0), counted=frozenset({("sensor:gps", "future")})),
    "gps_1_s_behind": Fault(transform=clock_off(-1.0), counted=frozenset({("sensor:gps", "too_old")})),
    "duplicated_and_reordered": Fault(
        transform=twice_and_mixed,
        counted=frozenset((f"sensor:{name}", "duplicate") for name in ("gps", "imu", "wheels")),
    ),
    "imu_frozen": Fault(
        {"imu_model": replace(INERTIAL, frozen_from=FROM_S)},
        counted=frozenset({("sensor:imu", "frozen")}),
        stays_valid=False,
    ),
    "imu_nan": Fault(transform=without_numbers, counted=frozenset({("sensor:imu", "nan")}), stays_valid=False),
    "one_wheel_stuck": Fault(_stuck("front_left")),
    "both_wheels_stuck": Fault(_stuck("front_left", "front_right"), counted=frozenset({("sensor:wheels", "gate")})),
    "looped_log": Fault(
        transform=loop_log,
        counted=frozenset((f"sensor:{name}", "out_of_sequence") for name in ("gps", "imu", "wheels")),
    ),
}
