"""Mount monitor: the angle of an IMU's mount from forces and wheels that are made here."""

from __future__ import annotations

import cmath
import math
import random

import pytest

from modelserver.estimation.filter.sensor_monitors import FEWEST, MountMonitor

PERIOD = 0.1


def drive(seconds: float, mount: float, monitor: MountMonitor, *, lean: complex = 0j, seed: int = 1) -> MountMonitor:
    """Return the monitor after a drive with an IMU turned by `mount`, rad; `lean` is the force by a tilt, m/s2."""
    noise = random.Random(seed)
    first = round(monitor.newest * 1e-6 / PERIOD) + 1
    for n in range(first, first + round(seconds / PERIOD)):
        t = n * PERIOD
        speed = 3.0 + math.sin(t / 2.0)
        rate = 0.4 * math.sin(t / 5.0)
        force = cmath.rect(1.0, mount) * complex(0.5 * math.cos(t / 2.0), speed * rate) + lean
        force += complex(noise.gauss(0.0, 0.2), noise.gauss(0.0, 0.2))
        monitor = monitor.update(round(t * 1e6), speed + noise.gauss(0.0, 0.03), rate, force)
    return monitor


@pytest.mark.parametrize("degrees", [90.0, 180.0, -90.0, 60.0])
def test_given_a_mount_turned_by_a_large_angle_then_it_is_wrong_by_about_that(degrees: float) -> None:
    monitor = drive(30.0, math.radians(degrees), MountMonitor())
    found = monitor.find_angle()
    assert monitor.is_wrong
    assert found is not None
    assert abs(cmath.phase(cmath.rect(1.0, found[0] - math.radians(degrees)))) < 0.2


@pytest.mark.parametrize("degrees", [0.0, 10.0, -20.0])
@pytest.mark.parametrize("seed", range(4))
def test_given_a_mount_that_is_nearly_right_then_it_is_not_wrong_and_confirmed(degrees: float, seed: int) -> None:
    monitor = MountMonitor()
    for _ in range(40):
        monitor = drive(2.0, math.radians(degrees), monitor, lean=0.1 + 0.05j, seed=seed)
        assert not monitor.is_wrong
    assert monitor.is_confirmed


def test_given_a_vehicle_that_stands_then_nothing_is_known_of_the_mount() -> None:
    monitor = MountMonitor()
    for n in range(600):
        monitor = monitor.update(1_000_000 + n * 100_000, 0.0, 0.0, 0.05 + 0.02j)
    assert monitor.find_angle() is None
    assert not monitor.is_wrong


def test_given_a_gap_in_the_samples_then_no_window_spans_it() -> None:
    monitor = drive(FEWEST - 1.0, 0.0, MountMonitor())
    windows = monitor.windows
    later = monitor.update(monitor.newest + 10_000_000, 50.0, 0.0, 0j)
    assert later.windows == windows
    assert later.speed == 50.0


def test_given_a_mount_once_confirmed_then_a_disturbance_that_would_do_at_first_is_not_enough() -> None:
    good = drive(60.0, 0.0, MountMonitor())
    assert good.is_confirmed
    turned = drive(3.0, math.pi / 2.0, good)
    assert not turned.is_wrong
    assert drive(3.0 + FEWEST, math.pi / 2.0, MountMonitor()).is_wrong


def test_given_a_mount_once_found_wrong_then_it_stays_so_until_the_motion_shows_the_contrary() -> None:
    turned = drive(60.0, math.pi, MountMonitor())
    assert turned.is_wrong
    # a hill makes it uncertain
    assert drive(20.0, math.pi, turned, lean=3.0 + 0j).is_wrong
    assert not drive(1500.0, 0.0, turned).is_wrong
