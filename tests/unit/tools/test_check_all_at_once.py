"""All faults of a vehicle file and what it names are reported in one run, whatever stage finds them."""

from __future__ import annotations

from pathlib import Path

import pytest

from mstools.commands.check import check_vehicle

pytestmark = pytest.mark.slow

VEHICLE = """\
vehicle: cart
geometry: geometry.yaml
base_frame: Cart:Origin
publish: {rate_hz: 50.0}
limits: {client_hz: 500.0, wait_ms: 2000}
origin: {persist: true}
sensors:
  gps: {channel: GPS, frame: Cart:Antenna, latency: 0.1}
  imu: {channel: IMU, frame: Cart:Imu}
  wheels:
    channel: WHEELS
    frames: {left: Cart:LeftWheel, right: Cart:RightWheel}
localization: {mode: full}
drivers:
  gps: {device: novatel, port: /dev/ttyS0, rate_hz: 10.0}
  imu: {device: gx1, port: /dev/ttyS1}
"""
GEOMETRY = """\
modelserver: geometry/1
bodies:
  Cart:
    frames:
      Origin: {}
      Antenna: {xyz: [0, 0, 1]}
      Imu: {xyz: [0.1, 0, 0.2], rpy_deg: [0, 0, 90]}
      LeftWheel: {xyz: [0, 0.3, 0]}
      RightWheel: {xyz: [0, -0.3, 0]}
      Mast: {xyz: [0, 0, 0.5]}
  Camera:
    description: looks ahead
    frames:
      Origin: {}
constraints:
  CameraFixed:
    from: Cart:Mast
    to: Camera:Origin
"""

FAULTS = [
    # where, what stands there, what is written instead, words of the problem
    ("vehicle", "geometry: geometry.yaml\n", "", "geometry is missing"),
    ("vehicle", "vehicle: cart\n", "", "vehicle is missing"),
    ("vehicle", "base_frame: Cart:Origin", "base_frame: Cart:Orgin", "no frame 'Orgin'"),
    ("vehicle", "base_frame: Cart:Origin\n", "", "base_frame is missing"),
    ("vehicle", "publish: {", "pubilsh: {", "unknown key 'pubilsh'"),
    ("vehicle", "client_hz: 500.0", "client_hz: 0.0", "client_hz is between 1 and 100000"),
    ("vehicle", "wait_ms: 2000", 'wait_ms: "2000"', "valid integer, got '2000'"),
    ("vehicle", "persist: true", "zone: 99", "a UTM zone is 1 to 60|given together"),
    ("vehicle", "frame: Cart:Antenna", "frame: Cart:Antena", "no frame 'Antena'"),
    ("vehicle", "frame: Cart:Imu", "frame: Crat:Imu", "no body 'Crat'"),
    ("vehicle", "left: Cart:LeftWheel", "left: Cart:LeftWeel", "no frame 'LeftWeel'"),
    ("vehicle", "latency: 0.1", "latency: 60.0", "latency is between 0 and 5"),
    ("vehicle", "mode: full", "mode: ful", "got 'ful'"),
    ("vehicle", "channel: IMU", "channel: POSE", "POSE is a channel of the server itself"),
    ("vehicle", "device: novatel", "device: novatl", "unknown device 'novatl'"),
    ("vehicle", "rate_hz: 10.0}", "rate_hz: -1.0}", "rate_hz"),
    ("vehicle", "port: /dev/ttyS1", "prot: /dev/ttyS1", "unknown key 'prot'"),
    ("geometry", "xyz: [0, 0.3, 0]", "xyz: [0, 0.3]", "xyz has 2 numbers, not 3"),
    ("geometry", "rpy_deg: [0, 0, 90]", "rpy_deg: [0, 0, x]", "rpy_deg: 'x' is not a number"),
    ("geometry", "description: looks", "descripton: looks", "unknown key 'descripton'"),
    ("geometry", "from: Cart:Mast", "from: Cart:Mats", "names frame 'Mats'"),
    ("geometry", "to: Camera:Origin", "", "to is missing"),
]
HIDING = {
    # with one of the left the other cannot be looked at
    "geometry: geometry.yaml\n": (
        "base_frame: Cart:Origin",
        "frame: Cart:Antenna",
        "frame: Cart:Imu",
        "left: Cart:LeftWheel",
    ),
    # a driver of an unknown kind has unknown keys
    "device: novatel": ("rate_hz: 10.0}",),
}


def check_faults(folder: Path, *faults: tuple[str, str, str, str]) -> set[tuple[str, str]]:
    """Return element and message of every problem of the vehicle with faults planted in it."""
    texts = {"vehicle": VEHICLE, "geometry": GEOMETRY}
    for where, good, bad, _ in faults:
        assert texts[where].count(good) == 1, good
        texts[where] = texts[where].replace(good, bad)
    for name, text in texts.items():
        (folder / f"{name}.yaml").write_text(text)
    _, problems = check_vehicle(str(folder / "vehicle.yaml"))
    return {(problem.element, problem.message) for problem in problems}


def test_the_vehicle_without_a_fault_is_clean(tmp_path: Path) -> None:
    assert check_faults(tmp_path) == set()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault[2] or f"no {fault[1].strip()}")
def test_a_fault_is_found_alone_and_beside_each_other_fault(tmp_path: Path, fault: tuple[str, str, str, str]) -> None:
    alone = check_faults(tmp_path, fault)
    assert any(part in message for _, message in alone for part in fault[3].split("|"))
    for other in FAULTS:
        hidden = other[1] in HIDING.get(fault[1], ()) or fault[1] in HIDING.get(other[1], ())
        is_same = other[1].strip() in fault[1] or fault[1].strip() in other[1]
        # without a geometry nothing of the geometry's file is found
        unread = "geometry: geometry.yaml\n" in (fault[1], other[1]) and "geometry" in (fault[0], other[0])
        if hidden or is_same or unread:
            continue
        both = check_faults(tmp_path, fault, other)
        assert alone <= both, f"{fault[2]!r} is not found beside {other[2]!r}"


@pytest.mark.parametrize(
    ("where", "right", "wrong"),
    [
        ("vehicle", "vehicle: cart", "vehicel: cart"),
        ("vehicle", "geometry: geometry", "geometri: geometry"),
        ("vehicle", "base_frame: ", "base_fram: "),
        ("vehicle", "channel: IMU", "chanel: IMU"),
        ("vehicle", "frame: Cart:Antenna", "fram: Cart:Antenna"),
        ("vehicle", "port: /dev/ttyS1", "prot: /dev/ttyS1"),
        ("geometry", "from: Cart:Mast", "form: Cart:Mast"),
    ],
)
def test_a_misspelled_required_key_is_one_problem(tmp_path: Path, where: str, right: str, wrong: str) -> None:
    ((_, message),) = check_faults(tmp_path, (where, right, wrong, ""))
    assert message == f"unknown key '{wrong.partition(':')[0]}'"


def test_the_value_of_a_misspelled_key_is_examined(tmp_path: Path) -> None:
    texts = [
        message
        for _, message in check_faults(tmp_path, ("vehicle", "base_frame: Cart:Origin", "base_fram: Cart:Orgin", ""))
    ]
    assert any("unknown key 'base_fram'" in text for text in texts)
    assert any("no frame 'Orgin'" in text for text in texts)
    assert len(texts) == 2


def test_five_faults_of_different_kinds_are_found_in_one_run(tmp_path: Path) -> None:
    kinds = [FAULTS[n] for n in (2, 4, 5, 9, 14, 17, 20)]
    messages = [message for _, message in check_faults(tmp_path, *kinds)]
    for _, _, _, words in kinds:
        assert any(part in message for message in messages for part in words.split("|")), words
    assert len(messages) == len(kinds)


def test_many_faults_at_once_are_each_found(tmp_path: Path) -> None:
    chosen = [fault for fault in FAULTS if fault[2] and "Orgin" not in fault[2] and "novatl" not in fault[2]]
    messages = [message for _, message in check_faults(tmp_path, *chosen)]
    missing = [words for *_, words in chosen if not any(p in m for m in messages for p in words.split("|"))]
    assert missing == []
