"""PLATFORM_GET_DYNAMICS and the tip-over margin of health reports, from a service on a fake bus."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support_dynamics import CART as GEOMETRY
from support_journal import JournalRig
from support_samples import ME, VEHICLE, write_vehicle

from modelserver.config.vehicle_file import load_config
from modelserver.dynamics import Dynamics
from modelserver.errors import ConfigError, Status
from modelserver.messages import (
    DynamicsReply,
    GetDynamics,
    Health,
    JointSample,
    JointsSample,
    Policy,
    SensorHeader,
    TimeQuery,
)
from modelserver.server.journal.verify import verify
from modelserver.server.vehicle import load_vehicle
from modelserver.wire.codec import decode

pytest.importorskip("pinocchio", reason="pin has no wheel for this Python")

DYNAMICS = "dynamics: {contacts: [Cart:FL, Cart:FR, Cart:RL, Cart:RR], mass_sigma: 0, center_sigma: 0.01}\n"

G = 9.80665


def slide(utime: int, position: float) -> JointsSample:
    return JointsSample(SensorHeader(utime, "arm", utime // 1000), (JointSample("Slide", position, 0.01, 0.0, 0.01),))


@pytest.fixture
def rig(tmp_path: Path) -> JournalRig:
    return JournalRig(tmp_path, VEHICLE + DYNAMICS, GEOMETRY)


def ask(rig: JournalRig, request: GetDynamics) -> DynamicsReply:
    rig.send(request)
    rig.run_cycles(10)
    reply = decode("get_dynamics_reply_t", rig.bus.get_published("REPLY_TEST")[-1])
    assert isinstance(reply, DynamicsReply)
    return reply


def last_health(rig: JournalRig) -> Health:
    health = decode("health_t", rig.bus.get_published("MODELSERVER_HEALTH")[-1])
    assert isinstance(health, Health)
    return health


def test_given_joints_at_a_time_then_mass_center_and_equations_are_those_of_that_time(rig: JournalRig) -> None:
    start = rig.clock.utime()
    for n in range(10):
        rig.send(slide(rig.clock.utime(), 0.1 * n))
        rig.run_cycles(1)
    at = start + (rig.clock.utime() - start) // 2
    reply = ask(rig, GetDynamics(ME, "Cart:Mast", True, False, TimeQuery(at, Policy.INTERPOLATED)))
    assert reply.header.status is Status.OK
    answer = reply.answer
    assert answer is not None
    assert (answer.utime, answer.frame, answer.coordinates) == (at, "Cart:Mast", ("Slide",))
    assert answer.mass == pytest.approx(100.0)
    y = 0.2 * answer.position[0]
    assert 0.01 < y < 0.17
    assert answer.center == pytest.approx((-0.5, y - 0.1, 0.6 - 1.0))
    assert answer.inertia[:1] == pytest.approx([100.0])
    assert answer.center_covariance is not None
    expected = (0.2 * 0.01) ** 2 + (0.8 * 0.01) ** 2 + (0.2 * 0.01) ** 2
    assert answer.center_covariance[4] == pytest.approx(expected, rel=0.5)
    assert answer.mass_matrix == pytest.approx((20.0,))
    assert answer.gravity == pytest.approx((0.0,), abs=1e-9)
    bare = ask(rig, GetDynamics(ME)).answer
    assert bare is not None
    assert (bare.coordinates, bare.mass_matrix) == ((), ())


def test_given_drive_then_floating_equations_hold_in_the_world_and_are_reproduced(rig: JournalRig) -> None:
    rig.drive(6.0)
    answer = ask(rig, GetDynamics(ME, "", True, True)).answer
    assert answer is not None
    names = tuple(f"Cart:Base.{each}" for each in ("x", "y", "z", "rx", "ry", "rz"))
    assert answer.coordinates == (*names, "Slide")
    D = np.array(answer.mass_matrix).reshape(7, 7)
    assert np.linalg.eigvalsh(D).min() > 0.0
    assert D[:3, :3] == pytest.approx(100.0 * np.eye(3))
    assert answer.gravity[:3] == pytest.approx((0.0, 0.0, 100.0 * G))
    assert math.hypot(*answer.rate[:2]) == pytest.approx(2.0, abs=0.3)
    found = verify(rig.finish())
    assert found.is_reproduced
    assert not found.unverifiable
    assert found.reproduced["replies"] >= 1


@pytest.mark.parametrize(
    ("request_", "status", "text"),
    [
        (GetDynamics(ME, "Cart:Mist"), Status.UNKNOWN_FRAME, "Mist"),
        (GetDynamics(ME, "", False, True), Status.NO_POSE, "pose"),
        (GetDynamics(ME, "", False, False, TimeQuery(5, Policy.INTERPOLATED)), Status.TOO_OLD, "Slide"),
    ],
)
def test_given_what_cannot_be_answered_then_the_status_states_why(rig, request_, status, text) -> None:
    rig.send(slide(rig.clock.utime(), 0.0))
    rig.run_cycles(2)
    header = ask(rig, request_).header
    assert header.status is status
    assert text in header.message


def test_given_no_section_then_the_request_is_forbidden(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, VEHICLE, GEOMETRY)
    header = ask(rig, GetDynamics(ME)).header
    assert header.status is Status.FORBIDDEN
    assert "section dynamics" in header.message


def test_given_a_fault_of_the_engine_then_it_costs_one_reply(tmp_path: Path, monkeypatch) -> None:
    rig = JournalRig(tmp_path, VEHICLE.partition("sensors:")[0] + DYNAMICS, GEOMETRY)

    def fail(*_, **__):
        raise RuntimeError("engine")

    with monkeypatch.context() as broken:
        broken.setattr(Dynamics, "center_of_mass", fail)
        assert ask(rig, GetDynamics(ME)).header.status is Status.INTERNAL
        rig.run_cycles(60)
        warnings = dict(last_health(rig).warnings)
    assert warnings["stability"] == "the tip-over margin cannot be computed: RuntimeError: engine"
    assert ask(rig, GetDynamics(ME)).header.status is Status.OK


def test_given_contacts_and_a_drive_then_health_has_margin_and_loads(rig: JournalRig) -> None:
    rig.drive(6.0)
    rig.run_cycles(60)
    stability = last_health(rig).stability
    assert stability.margin == pytest.approx(math.atan2(0.4, 0.6), abs=0.05)
    assert 0.0 < stability.margin_sigma < 0.2
    assert stability.contacts == ("Cart:FL", "Cart:FR", "Cart:RL", "Cart:RR")
    assert sum(stability.loads) == pytest.approx(100 * G, rel=0.2)
    assert stability.limit == 0.1
    assert "stability" not in dict(last_health(rig).warnings)


def test_given_no_fixes_then_the_margin_comes_from_odom_and_its_sigma_is_not_known(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, VEHICLE.replace("  gps: {channel: GPS, frame: Cart:Antenna}\n", "") + DYNAMICS, GEOMETRY)
    rig.drive(6.0)
    rig.run_cycles(60)
    stability = last_health(rig).stability
    assert stability.margin == pytest.approx(math.atan2(0.4, 0.6), abs=0.05)
    assert math.isnan(stability.margin_sigma)


def test_given_arm_far_aside_then_health_warns_at_once(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, VEHICLE.partition("sensors:")[0] + DYNAMICS, GEOMETRY)
    rig.run_cycles(60)
    assert last_health(rig).stability.margin == pytest.approx(math.atan2(0.4, 0.6))
    assert math.isnan(last_health(rig).stability.dynamic_margin)
    reports = len(rig.bus.get_published("MODELSERVER_HEALTH"))
    rig.send(slide(rig.clock.utime(), 1.9))
    rig.run_cycles(12)
    # reports of a change come between those of the period
    assert len(rig.bus.get_published("MODELSERVER_HEALTH")) > reports
    warning = dict(last_health(rig).warnings)["stability"]
    assert warning == "static tip-over margin 1.9 deg, below the limit of 5.7 deg: it is close to tipping"
    rig.send(slide(rig.clock.utime(), 2.1))
    rig.run_cycles(60)
    assert dict(last_health(rig).warnings)["stability"].endswith("the vehicle tips")
    assert all(map(math.isnan, last_health(rig).stability.loads))


@pytest.mark.parametrize(
    ("section", "text"),
    [
        ("dynamics: {contacts: [Cart:FL, Cart:FR]}\n", "3 to 16 different frames, got 2"),
        ("dynamics: {contacts: [Cart:FL, Cart:FR, Cart:RX]}\n", "Cart has no frame 'RX'"),
        ("dynamics: {margin_limit: 10}\n", "margin_limit is between 0 and 1.57 radians, got 10"),
        ("dynamics: {}\n", ""),
    ],
)
def test_given_wrong_section_then_the_vehicle_file_is_rejected_with_the_reason(tmp_path, section, text) -> None:
    path = write_vehicle(tmp_path, VEHICLE + section, GEOMETRY)
    if not text:
        load_vehicle(load_config(path), str(path))
        return
    with pytest.raises(ConfigError, match=text):
        load_vehicle(load_config(path), str(path))


def test_given_body_without_mass_then_the_vehicle_file_is_rejected_with_its_name(tmp_path: Path) -> None:
    path = write_vehicle(
        tmp_path,
        VEHICLE + "dynamics: {}\n",
        GEOMETRY.replace("    inertia: {mass: 20, center: [0, 0, 1], moments: [1, 1, 1]}\n", ""),
    )
    with pytest.raises(ConfigError, match=r"vehicle.yaml:8 \(dynamics\): error: no mass is stated for Arm"):
        load_vehicle(load_config(path), str(path))
    config = load_config(path)
    assert config.dynamics is not None
    load_vehicle(replace(config, dynamics=replace(config.dynamics, allow_massless=True)), str(path))


def test_given_no_pinocchio_then_the_vehicle_file_is_rejected_with_what_to_install(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    path = write_vehicle(tmp_path, VEHICLE + DYNAMICS, GEOMETRY)
    with pytest.raises(ConfigError, match=r"dynamics needs Pinocchio .*pip install .*\[dynamics\]'"):
        load_vehicle(load_config(path), str(path))


@pytest.mark.slow
@pytest.mark.parametrize(("section", "loaded"), [("", "False"), ("dynamics: {}\n", "True")])
def test_given_vehicle_file_then_pinocchio_is_loaded_only_with_the_section(tmp_path, section, loaded) -> None:
    path = write_vehicle(tmp_path, VEHICLE + section, GEOMETRY)
    code = (
        "import sys\nfrom modelserver.server import daemon\nfrom modelserver.config.vehicle_file import load_config\n"
        "from modelserver.server.vehicle import load_vehicle\n"
        f"load_vehicle(load_config({str(path)!r}), '')\nprint('pinocchio' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"{loaded}\n"
