"""Whatever the bytes, a file is a model or a GeometryError that states place and fix."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support_formats import YAML, miro, models, tree, tree_frame
from support_urdf import BOT_FRAMES, URDF

from modelserver.errors import GeometryError, Severity
from modelserver.formats import parse_model, save_model

pytestmark = pytest.mark.slow

TREE = tree(tree_frame("$MRN"), tree_frame("Mast", "$MRN", X="1.5", Yaw="90"), tree_frame("Camera", "Mast", Roll="-3"))
JOINTS = YAML.replace(
    "xyz: [0, 0, 0.1]", "joint: {type: revolute, axis: [0, 1, 0], limits_deg: [-9, 9], mimic: Lift}"
) + ("  Lift: {from: Cart:Mast, to: Camera:Origin, joint: {type: planar, limits: {x: [-1, .inf]}, sigma: {x: 1}}}\n")
FILES = [YAML.encode(), miro().encode(), TREE.encode(), JOINTS.encode(), URDF.encode(), BOT_FRAMES.encode()]

PIECES = [
    *(b"<", b">", b'"', b"/>", b"<!--", b"-->", b"<!DOCTYPE x [", b"&amp;", b"&x;", b"<parameter>", b"]]>", b"<?x?>"),
    *(
        b"[",
        b"]",
        b"{",
        b"}",
        b": ",
        b"- ",
        b"\n",
        b"\t",
        b"&a ",
        b"*a",
        b"!!int ",
        b"<<: ",
        b"---\n",
        b"|",
        b"%",
        b"#",
    ),
    *(
        b"nan",
        b"1e308",
        b"-1e308",
        b"1e-320",
        b"99999999999999999999",
        b"\x00",
        b"\xff",
        b"\xef\xbb\xbf",
        b"\xed\xa0\x80",
    ),
    *(
        b"$MRN",
        b"${X}",
        b"World",
        b"Origin",
        b"Cart:Mast",
        b"name=",
        b"value=",
        b"Row1",
        b"xyz",
        b"quaternion",
        b"mimic: ",
        b"<link",
        b"<joint",
        b"<mimic",
        b"lower=",
        b"joint=",
        b"fixed",
        b"mast",
        b"cart",
        b"${x}",
        b"<mesh/>",
    ),
    *(b"=", b";", b"coordinate_frames {", b"relative_to", b"rpy", b"body", b"local", b'"', b"(cast)"),
    *(b"revolute", b"prismatic", b"planar", b"_deg", b"axis: ", b"sigma: ", b".inf", b"CameraFixed"),
]


@st.composite
def mutate(draw):
    content = bytearray(draw(st.sampled_from(FILES)))
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.integers(0, len(content)))
        length = draw(st.sampled_from((0, 0, 1, 3, 20, 200)))
        content[at : at + length] = draw(st.sampled_from(PIECES) | st.binary(max_size=4))
    return bytes(content)


def assert_loads_or_explains(content, file=""):
    for repair in (False, True):
        try:
            model = parse_model(content, file, repair=repair)
        except GeometryError as error:
            problems = error.problems
            wrong = True
        else:
            problems = model.problems
            wrong = not model.bodies
        assert wrong == any(problem.severity is Severity.ERROR for problem in problems)
        for problem in problems:
            assert problem.message
            assert problem.fix or problem.severity is not Severity.ERROR
            assert 0 <= problem.line <= content.count(b"\n") + content.count(b"\r") + 2


@given(mutate())
@settings(max_examples=400)
def test_a_damaged_file_is_a_model_or_an_error(content):
    assert_loads_or_explains(content)


@given(st.binary(max_size=200), st.sampled_from(["", "a.xml", "a.yaml", "a.urdf"]))
def test_any_bytes_are_a_model_or_an_error(content, file):
    assert_loads_or_explains(content, file)


@given(st.text(max_size=200), st.sampled_from(["", "bodies: ", "<config>", "<robot>", "coordinate_frames {"]))
def test_any_text_is_a_model_or_an_error(text, before):
    assert_loads_or_explains((before + text).encode())


@pytest.mark.parametrize("file_format", ["yaml", "miro", "urdf"])
@given(model=models(), part=st.floats(0, 1))
@settings(max_examples=10)
def test_a_file_cut_short_is_a_model_or_an_error(file_format, model, part):
    content = save_model(model, file_format).text.encode()
    assert_loads_or_explains(content[: int(len(content) * part)])
