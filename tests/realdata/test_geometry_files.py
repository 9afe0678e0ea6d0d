"""The report's Annex C and NASA's rovers, as they are."""

import math

import pytest
from support_formats import all_frames, assert_same_transforms, read

from modelserver.errors import Severity
from modelserver.formats import load_model, save_model

pytestmark = pytest.mark.realdata

NASA = {"K10MiniFrames.xml": (16, 37, 15), "K11Frames.xml": (16, 36, 15), "LerFrames.xml": (2, 7, 1)}


@pytest.fixture
def miro(data_dir, monkeypatch):
    monkeypatch.delenv("MRN", raising=False)
    return data_dir / "geometry" / "miro"


def findings(model):
    return [problem for problem in model.problems if problem.severity is not Severity.NOTE]


def test_the_reports_file_is_clean_and_answers_as_the_report_measured(miro):
    model = load_model(miro / "report_annex_C.xml")
    assert findings(model) == []
    found = model.get_transformation("Digiclops:ImagePlane", "FrontNoddingSICK:Origin")
    assert found.position == pytest.approx([0.299, -0.056, 0.433], abs=1e-12)
    # the file gives four decimals of sine and cosine
    assert [math.degrees(angle) for angle in found.rpy] == pytest.approx([0, -19.25, 0], abs=0.006)
    back = model.get_transformation("FrontNoddingSICK:Origin", "Digiclops:ImagePlane")
    assert back.pose.is_close(found.pose.inverse(), 1e-15, 1e-15)


@pytest.mark.parametrize("name", NASA)
def test_nasas_files_load_with_true_findings_only(miro, name):
    model = load_model(miro / name, variables={"MRN": "Rover"})
    assert model.root.name == "Rover"
    assert (len(model.bodies), len(all_frames(model)), len(model.constraints)) == NASA[name]
    if name != "LerFrames.xml":
        assert findings(model) == []
        return
    (twice,) = findings(model)
    assert "XsensGpsAntenna is defined twice: on line 30 and on line 41" in twice.message
    assert "0.583095 m and 0 deg apart" in twice.message
    assert twice.line == 41


@pytest.mark.parametrize("name", NASA)
def test_a_rover_without_a_name_keeps_its_variable_and_reports_how_to_name_it(miro, name):
    model = load_model(miro / name)
    assert model.root.name == "$MRN"
    assert "--set MRN=NAME" in findings(model)[0].fix


def test_numbers_of_a_rover_are_retained_verbatim(miro):
    model = load_model(miro / "K11Frames.xml")
    wheel = model.get_transformation("RightFrontSteerFrame:RightFrontWheelMount", "$MRN:Origin")
    assert wheel.position == pytest.approx([0.406, 0.389, -0.352 + 0.207], abs=1e-15)
    up = model.get_transformation("$MRN:ZUp", "$MRN:Origin")
    assert up.pose.transform((0, 0, 1)) == pytest.approx([0, 0, -1], abs=1e-15)


@pytest.mark.parametrize("form", ["yaml", "miro"])
@pytest.mark.parametrize("name", [*NASA, "report_annex_C.xml"])
def test_every_pair_of_frames_survives_conversion_and_back(miro, name, form):
    model = load_model(miro / name)
    through = read(save_model(model, form).text)
    assert_same_transforms(model, through)
    assert_same_transforms(model, read(save_model(through, "miro").text))
    assert_same_transforms(model, read(save_model(through, "yaml").text))
