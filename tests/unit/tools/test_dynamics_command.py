from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from support_dynamics import CART

from mstools.cli import main

pytest.importorskip("pinocchio", reason="pin has no wheel for this Python")

CONTACTS = [word for name in ("FL", "FR", "RL", "RR") for word in ("--contact", f"Cart:{name}")]


@pytest.fixture
def geometry(tmp_path: Path) -> str:
    (tmp_path / "geometry.yaml").write_text(CART)
    return str(tmp_path / "geometry.yaml")


def run(capsys, *arguments: str) -> str:
    with pytest.raises(SystemExit) as end:
        main(["dynamics", *arguments])
    found = capsys.readouterr()
    assert end.value.code == 0, found.err
    return found.out


def test_given_geometry_then_mass_and_center_are_printed(capsys, geometry) -> None:
    text = run(capsys, "Cart:Base", "--model", geometry)
    assert "mass            100.000 kg" in text
    assert "center of mass  0.0000  0.0000  0.6000  m in Cart:Base" in text
    assert "margin" not in text


def test_given_payload_and_pose_of_the_arm_then_margin_is_printed_beside_that_without(capsys, geometry) -> None:
    words = ["--model", geometry, *CONTACTS, "--joint", "Slide=0.5", "--payload", "Arm:Foot=100", "--json"]
    found = json.loads(run(capsys, *words))
    assert found["mass"] == pytest.approx(200.0)
    assert found["center"] == pytest.approx([0.0, (20 + 100) * 0.5 / 200, 60 / 200])
    assert found["stability"]["margin_deg"] == pytest.approx(math.degrees(math.atan2(0.1, 0.3)))
    assert found["without changes"]["margin_deg"] == pytest.approx(math.degrees(math.atan2(0.4, 0.6)))
    assert sum(found["stability"]["loads"].values()) == pytest.approx(200 * 9.80665)
    pattern = ["--contact", "Cart:[FR][LR]"]
    assert json.loads(run(capsys, *[each for each in words if each not in CONTACTS], *pattern)) == found
    assert "TIPS" in run(capsys, *words[:-1], "--acceleration", "0", "-4", "0")


def test_given_joint_without_sigma_then_that_of_center_and_margin_is_not_known(capsys, geometry) -> None:
    words = ["--model", geometry, *CONTACTS, "--json"]
    known = json.loads(run(capsys, *words))
    assert known["stability"]["sigma_deg"] > 0.0
    path = Path(geometry)
    path.write_text(path.read_text().replace(", sigma: 0.01", ""))
    found = json.loads(run(capsys, *words))
    assert found["center_sigma"] is None
    assert found["stability"]["sigma_deg"] is None


def test_given_tilt_then_gravity_acts_on_the_joints_and_the_matrix_is_written(capsys, geometry, tmp_path) -> None:
    npy = tmp_path / "D.npy"
    words = ["--model", geometry, "--tilt-deg", "30", "0", "--equations", "--npy", str(npy), "--json"]
    found = json.loads(run(capsys, *words))
    assert found["coordinates"] == ["Slide"]
    # upright it needs no force; rolled to the right it slides down to -y
    assert found["gravity"] == pytest.approx([20 * 9.80665 * 0.5])
    assert np.load(npy) == pytest.approx(np.array([[20.0]]))
    floating = json.loads(run(capsys, *words, "--floating"))
    assert len(floating["coordinates"]) == 7
    assert "Slide  0  98.07  |        20" in run(capsys, *words[:-1])


def test_given_vehicle_file_then_its_contacts_and_base_frame_are_used(capsys, geometry, tmp_path) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(
        "vehicle: cart\ngeometry: geometry.yaml\nbase_frame: Cart:Base\n"
        "dynamics: {contacts: [Cart:FL, Cart:FR, Cart:RL], mass_sigma: 0, center_sigma: 0}\n"
    )
    found = json.loads(run(capsys, "-c", str(path), "--mass", "Cart=180", "--json"))
    assert found["frame"] == "Cart:Base"
    assert list(found["stability"]["loads"]) == ["Cart:FL", "Cart:FR", "Cart:RL"]
    assert found["mass"] == pytest.approx(200.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--model", "{}", "--joint", "Slide"], "'Slide' is not NAME=NUMBER"),
        (["--model", "{}", "--joint", "Slid=1"], "Nearest: Slide"),
        (["--model", "{}", "--contact", "Cart:?Z"], "has no frame '?Z'"),
        (["--model", "{}", "--payload", "Arm:Food=1"], "Arm has no frame 'Food'"),
    ],
)
def test_given_wrong_words_then_the_error_names_them(capsys, geometry, words, message) -> None:
    with pytest.raises(SystemExit) as end:
        main(["dynamics", *(word.format(geometry) for word in words)])
    assert end.value.code in (1, 2)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["--set", "MRN=K11"],
        ["--joint", "Slide=1"],
        ["--payload", "Arm:Foot=1"],
        ["--mass", "Cart=90"],
        ["--contact", "Cart:FL"],
        ["--tilt-deg", "0", "5"],
        ["--acceleration", "0", "0", "1"],
        ["--allow-massless"],
        ["--cut-loops"],
    ],
)
def test_given_option_of_a_file_without_one_then_the_error_names_what_to_add(capsys, words) -> None:
    with pytest.raises(SystemExit) as end:
        main(["dynamics", *words])
    assert end.value.code == 2
    text = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert words[0] in text
    assert "has no effect on the running daemon, which has its own; add --model FILE or --config FILE" in text
