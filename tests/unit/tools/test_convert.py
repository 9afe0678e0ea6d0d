"""`modelserver convert`."""

import os
import stat

import pytest
from support_formats import YAML, assert_same_transforms, miro, miro_body, tree, tree_frame
from support_urdf import BOT_FRAMES, URDF

from modelserver.formats import load_model
from mstools.cli import main


@pytest.fixture
def convert(tmp_path, capsys, monkeypatch):
    """Return a function that runs the command in a folder with cart.yaml; gives exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cart.yaml").write_text(YAML)

    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(["convert", *arguments])
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return run


def test_the_ending_chooses_the_form_and_the_transforms_stay(convert):
    assert convert("cart.yaml", "cart.xml") == (0, "", "cart.xml: 2 bodies, 3 frames, 1 constraint\n")
    assert convert("cart.xml", "again.yml")[0] == 0
    assert_same_transforms(load_model("cart.yaml"), load_model("again.yml"))


def test_urdf_and_libbot2_frames_are_read_and_urdf_is_written(convert, tmp_path):
    (tmp_path / "frames.cfg").write_text(BOT_FRAMES)
    assert convert("frames.cfg", "frames.urdf")[0] == 0
    assert load_model("frames.urdf").get_body_list() == ["local", "body", "laser"]
    (tmp_path / "robot.urdf").write_text(URDF)
    assert convert("robot.urdf", "again.urdf") == (0, "", "again.urdf: 3 bodies, 5 frames, 2 constraints\n")


def test_what_the_form_cannot_hold_is_reported(convert, tmp_path):
    (tmp_path / "cart.yaml").write_text(YAML.replace("xyz: [0, 0, 0.1]", "sigma: {xyz: 0.001}") + "name: Cart\n")
    _, _, err = convert("cart.yaml", "cart.xml")
    assert "the format does not support the model's name, Cart" in err
    assert "the format does not support the sigmas of 1 constraint" in err
    assert "CameraFixed" in err


def test_standard_output_needs_a_form(convert):
    code, out, err = convert("cart.yaml", "-")
    assert (code, out) == (2, "")
    assert "--to" in err
    assert convert("cart.yaml", "-", "--to", "yaml")[1].startswith("modelserver: geometry/1\n")
    assert convert("cart.yaml", "-", "--to", "miro")[1].startswith("<?xml")


def test_an_unknown_form_or_ending_is_wrong_usage(convert):
    code, _, err = convert("cart.yaml", "cart.json")
    assert code == 2
    assert ".yaml" in err
    code, _, err = convert("cart.yaml", "cart.xml", "--to", "mir")
    assert code == 2
    assert "did you mean miro" in err


def test_an_existing_file_is_retained_without_force(convert, tmp_path):
    (tmp_path / "out.xml").write_text("mine")
    os.chmod("out.xml", 0o640)
    code, _, err = convert("cart.yaml", "out.xml")
    assert code == 1
    assert "already exists; give --force" in err
    assert (tmp_path / "out.xml").read_text() == "mine"
    assert convert("cart.yaml", "out.xml", "--force")[0] == 0
    assert load_model("out.xml").root.name == "Cart"
    assert stat.S_IMODE(os.stat("out.xml").st_mode) == 0o640


def test_a_file_may_be_replaced_by_itself(convert):
    assert convert("cart.yaml", "cart.yaml", "--force")[0] == 0
    assert load_model("cart.yaml").root.name == "Cart"


def test_a_file_with_errors_writes_nothing_and_reports_them_all(convert, tmp_path):
    (tmp_path / "bad.yaml").write_text(
        YAML.replace("[0.2, 0, 1.1]", "[0.2, 0]").replace("Camera:Origin", "Camera:Orign")
    )
    code, _, err = convert("bad.yaml", "out.xml")
    assert code == 1
    assert "bad.yaml:6: error: xyz has 2 numbers" in err
    assert "nearest: Camera:Origin" in err
    assert "2 errors; nothing was written" in err
    assert sorted(os.listdir()) == ["bad.yaml", "cart.yaml"]


def test_repair_drops_and_reports_it(convert, tmp_path):
    (tmp_path / "two.xml").write_text(miro([miro_body("Cart"), miro_body("Lamp")], []))
    code, _, err = convert("two.xml", "one.yaml", "--repair")
    assert code == 0
    assert "Lamp is an orphan" in err
    assert load_model("one.yaml").get_body_list() == ["Cart"]


def test_variables_are_filled_in(convert, tmp_path):
    (tmp_path / "rover.xml").write_text(tree(tree_frame("$MRN"), tree_frame("Mast", "$MRN"), tree_frame("Eye", "Mast")))
    assert convert("rover.xml", "rover.yaml", "--set", "MRN=K11")[0] == 0
    assert load_model("rover.yaml").root.name == "K11"


def test_a_folder_that_is_missing_or_a_target_that_is_a_folder_is_one_line(convert, tmp_path):
    for target in ("none/out.xml", "folder.xml"):
        (tmp_path / "folder.xml").mkdir(exist_ok=True)
        code, _, err = convert("cart.yaml", target, "--force")
        assert code == 1
        assert err.count("\n") == 1
    assert convert("none.yaml", "out.xml") == (1, "", "modelserver: none.yaml: No such file or directory\n")


def test_help_has_an_example(convert):
    code, out, _ = convert("--help")
    assert code == 0
    assert "Examples:\n    modelserver convert" in out
