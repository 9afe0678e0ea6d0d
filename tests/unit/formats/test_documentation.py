"""The example in docs/geometry-files.md is what it says it is."""

import math
from pathlib import Path

from support_formats import read

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "geometry-files.md"


def test_the_worked_example_is_clean_and_does_what_its_comments_say():
    text = DOCUMENT.read_text(encoding="utf-8")
    model = read(text.split("```yaml\n")[1].split("```")[0])
    assert model.problems == ()
    assert model.get_body_frame_list("RearCamera") == ["Origin", "Left", "Right", "Lamp"]
    assert model.frame("RearCamera:Left").pose.xyz == (0.0, 0.051, 0.0)
    assert model.frame("Cart:MastFoot").sigma.rotation == (math.radians(0.2),) * 3
    assert model.frame("Cart:Origin").sigma is None
    assert model.get_transformation("FrontCamera:Left", "Cart:Origin").covariance is not None
