"""Miro body and constraint XML: what is read, and the error for each bad input."""

import pytest
from support_formats import (
    IDENTITY_ROWS,
    line_of,
    miro,
    miro_body,
    miro_constraint,
    miro_frame,
    only_problem,
    problems_of,
    read,
    rows,
)

from modelserver.errors import GeometryError, Severity
from modelserver.geometry import Search

CART_AND = [miro_body("Cart", miro_frame("Origin"), miro_frame("Mast")), miro_body("Camera")]


def with_row(text, number=2):
    """Return a file in which one row of Cart's Mast is `text`."""
    values = list(IDENTITY_ROWS)
    values[number - 1] = text
    mast = miro_frame("Mast", rows(values))
    return miro([miro_body("Cart", miro_frame("Origin"), mast), miro_body("Camera")])


def test_a_file_as_in_the_report_gives_bodies_frames_and_constraints_in_order():
    model = read(miro())
    assert model.get_body_list() == ["Cart", "Camera"]
    assert model.get_body_frame_list("Cart") == ["Origin", "Mast"]
    assert [(each.name, each.from_, each.to) for each in model.constraints] == [
        ("CameraFixed", "Cart:Mast", "Camera:Origin")
    ]
    assert model.problems == ()


def test_names_of_the_section_and_of_the_lists_do_not_matter():
    text = miro().replace("BodyList", "Bodies").replace("ConstraintList", "Joints").replace('"Geometry"', '"test"')
    assert read(text).get_body_list() == ["Cart", "Camera"]


def test_bodies_and_constraints_need_no_list_at_all():
    joint = miro_constraint("C", "Cart:Mast", "Camera:Origin")
    text = f"<config><section>{CART_AND[0]}{joint}{CART_AND[1]}</section></config>"
    assert len(read(text).constraints) == 1


def test_odd_spacing_comments_and_processing_instructions_are_no_matter():
    text = (
        with_row("  0.0\t1.00   0\n  -.5e+1 ")
        .replace("Cart:Mast", "  Cart : Mast ")
        .replace('value="Camera"', 'value=" Camera\n"')
        .replace('name="Row1"', 'name=" Row1 "')
        .replace('<parameter name="Frames">', '<parameter name="Frames"> <!-- list --> <?keep this?>')
    )
    model = read(text)
    assert model.frame("Cart:Mast").pose.xyz == (0.0, -5.0, 0.0)
    assert model.body("Camera").frames[0].name == "Origin"


def test_numbers_are_read_verbatim():
    model = read(with_row("0 1 0 0.1234567890123456789"))
    assert model.frame("Cart:Mast").pose.xyz[1] == 0.1234567890123456789


def test_a_body_may_carry_a_transform_and_descriptions():
    body = miro_body("Cart").replace(
        '<parameter name="Frames">',
        '<parameter name="Description" value="  the\n   cart "/>'
        + rows(("1 0 0 7", *IDENTITY_ROWS[1:]))
        + '<parameter name="Frames">',
    )
    model = read(miro([body, CART_AND[1]], [miro_constraint("C", "Cart:Origin", "Camera:Origin")]))
    assert model.body("Cart").pose.xyz == (7.0, 0.0, 0.0)
    assert model.body("Cart").description == "the cart"


def test_a_missing_htransform_is_the_identity_and_a_note():
    text = miro([miro_body("Cart", miro_frame("Origin"), miro_frame("Mast", "")), CART_AND[1]])
    model = read(text)
    assert model.frame("Cart:Mast").pose.xyz == (0.0, 0.0, 0.0)
    assert [problem.severity for problem in model.problems] == [Severity.NOTE]


def test_a_fourth_row_is_read_if_it_is_constant():
    text = miro().replace("</parameter>\n</parameter>", "</parameter></parameter>", 0)
    fourth = '<parameter name="Row3" value="0 0 1 0"/><parameter name="Row4" value="0 0 0 1"/>'
    assert read(text.replace('<parameter name="Row3" value="0 0 1 0"/>', fourth, 1))
    wrong = only_problem(
        text.replace('<parameter name="Row3" value="0 0 1 0"/>', fourth.replace("0 0 0 1", "0 0 1 1"), 1)
    )
    assert "Row4" in wrong.message


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("0 1 0", "Row2 has 3 numbers, not 4"),
        ("0 1 0 0 0", "Row2 has 5 numbers, not 4"),
        ("", "Row2 has 0 numbers, not 4"),
        ("0 one 0 0", "Row2: 'one' is not a number"),
        ("0 1 0 nan", "Row2: 'nan' is not a finite number"),
        ("0 1 0 -inf", "Row2: '-inf' is not a finite number"),
        ("0 1 0 1e999", "Row2: '1e999' is too large for a number"),
        ("0, 1, 0, 0", "Row2: '0,' is not a number (decimals take a point, and spaces divide numbers)"),
        ("0 1_0 0 0", "Row2: '1_0' is not a number"),
        ("0 0x1 0 0", "Row2: '0x1' is not a number"),
        ("0 \N{ARABIC-INDIC DIGIT ONE} 0 0", "Row2: '\N{ARABIC-INDIC DIGIT ONE}' is not a number"),
    ],
)
def test_a_bad_row_is_named_with_its_line_and_how_to_write_it(row, message):
    text = with_row(row)
    problem = only_problem(text)
    assert problem.message == message
    assert problem.line == line_of(text, f'value="{row}"')
    assert problem.element == "body Cart, frame Mast, HTransform" + (", Row2")
    assert '<parameter name="Row2" value="r r r p"/>' in problem.fix
    assert problem.file == "file"


def test_a_missing_row_is_reported_at_its_htransform():
    text = with_row("gone").replace('<parameter name="Row2" value="gone"/>\n', "")
    problem = only_problem(text)
    assert problem.message == "Row2 is missing"
    assert problem.element == "body Cart, frame Mast, HTransform"
    assert 'name="Row2"' in problem.fix


def test_every_problem_of_a_file_is_reported_at_once_in_the_order_of_the_file():
    text = (
        with_row("0 1 0").replace('value="Cart:Mast"', 'value="Cart:Mats"').replace('value="1 0 0 0"', 'value="x"', 1)
    )
    found = problems_of(text)
    assert [problem.message.split(":")[0] for problem in found] == [
        "Row1",
        "Row2 has 3 numbers, not 4",
        "constraint 'CameraFixed'",
    ]
    assert [problem.line for problem in found] == sorted(problem.line for problem in found)
    assert found[2].nearest == ("Cart:Mast",)


@pytest.mark.parametrize(
    ("wrong", "right", "element"),
    [
        ("Discription", "Description", "body Cart, frame Mast"),
        ("htransform", "HTransform", "body Cart, frame Mast"),
    ],
)
def test_an_unknown_parameter_is_a_warning_with_the_nearest_name(wrong, right, element):
    mast = miro_frame("Mast", f'<parameter name="{wrong}" value="x"/>')
    problem = only_problem(miro([miro_body("Cart", mast), CART_AND[1]]), Severity.WARNING)
    assert problem.nearest == (right,)
    assert problem.fix == f"write {right}"
    assert problem.element == element


def test_a_parameter_that_is_given_already_is_not_proposed():
    mast = miro_frame("Mast", f'<parameter name="HTransfrom" value="x"/>{rows()}')
    problem = only_problem(miro([miro_body("Cart", mast), CART_AND[1]]), Severity.WARNING)
    assert problem.nearest == ()


def test_a_misspelt_row_is_both_unknown_and_missing():
    text = miro().replace('name="Row2"', 'name="Rwo2"', 1)
    unknown, missing = sorted(problems_of(text), key=lambda problem: problem.severity)[::-1]
    assert unknown.severity is Severity.WARNING
    assert unknown.nearest[0] == "Row2"
    assert missing.message == "Row2 is missing"


@pytest.mark.parametrize(
    ("wrong", "right"), [("BodyNmae", "BodyName"), ("bodyname", "BodyName"), ("ConstraintNam", "ConstraintName")]
)
def test_a_body_or_constraint_whose_name_is_misspelt_is_not_lost_in_silence(wrong, right):
    text = miro().replace(right, wrong, 1)
    problem = next(each for each in problems_of(text) if each.severity is Severity.ERROR)
    assert "neither a body nor a constraint" in problem.message
    assert problem.nearest == (right,)
    assert problem.fix == f"write {right}"


def test_a_misspelt_list_of_frames_is_taken_for_it_with_a_warning():
    problem = only_problem(miro().replace('"Frames"', '"Frame"', 1), Severity.WARNING)
    assert problem.nearest == ("Frames",)


def test_an_unexpected_element_is_a_warning():
    text = miro().replace('<parameter name="ConstraintList">', '<paramter/><parameter name="ConstraintList">')
    problem = only_problem(text, Severity.WARNING)
    assert "<paramter>" in problem.message
    assert problem.nearest == ("parameter",)


def test_a_parameter_twice_is_an_error_that_names_the_first():
    text = miro().replace(
        '<parameter name="Row2" value="0 1 0 0"/>', '<parameter name="Row2" value="0 1 0 0"/>\n' * 2, 1
    )
    problem = only_problem(text)
    first = line_of(text, 'name="Row2"')
    assert problem.message == f"parameter Row2 is given twice (first on line {first})"
    assert problem.line == first + 1


def test_a_parameter_without_value_is_an_error():
    text = miro().replace('name="From" value="Cart:Mast"', 'name="From"')
    assert only_problem(text).message == "parameter From has no value"


def test_a_constraint_without_an_end_is_an_error():
    text = miro().replace('<parameter name="To" value="Camera:Origin"/>\n', "")
    problem = only_problem(text)
    assert problem.message == "To is missing"
    assert problem.element == "constraint CameraFixed"
    assert 'name="To"' in problem.fix


def test_a_frame_without_a_name_is_an_error():
    assert (
        "frame without a name"
        in only_problem(
            miro([miro_body("Cart", miro_frame("Mast"), f"<parameter>{rows()}</parameter>"), CART_AND[1]])
        ).message
    )


# what the builder checks, seen from a file: the line must be that of the file


def test_a_body_twice_names_both_lines():
    text = miro([*CART_AND, miro_body("Cart")])
    problem = only_problem(text)
    second = text[: text.rindex('value="Cart"')].count("\n")
    assert problem.line == second
    assert f"file:{line_of(text, 'value=' + chr(34) + 'Cart') - 1}" in problem.message
    assert "rename one" in problem.fix


def test_a_missing_frame_of_a_constraint_offers_the_nearest():
    text = miro(constraints=[miro_constraint("C", "Cart:Mats", "Camera:Origin")])
    problem = only_problem(text)
    assert problem.nearest == ("Cart:Mast",)
    assert problem.fix == "write Cart:Mast"
    assert problem.line == line_of(text, "ConstraintName") - 1


def test_from_equals_to_is_rejected():
    text = miro(constraints=[miro_constraint("C", "Cart:Mast", "Cart:Mast")])
    problem = only_problem(text)
    assert "From equals To" in problem.message
    assert "two different frames" in problem.fix


def test_given_strict_then_a_frame_with_two_constraints_is_rejected_and_both_are_named():
    both = [miro_constraint("A", "Cart:Mast", "Camera:Origin"), miro_constraint("B", "Cart:Mast", "Laser:Origin")]
    text = miro([*CART_AND, miro_body("Laser")], both)
    assert read(text).problems == ()
    problem = only_problem(text, strict=True)
    assert "already has constraint A" in problem.message
    assert problem.element == "constraint B"
    assert "add a frame of its own" in problem.fix


def test_orphans_load_with_a_warning_and_repair_drops_them():
    text = miro([*CART_AND, miro_body("Laser")])
    problem = only_problem(text, Severity.WARNING)
    assert "Laser is an orphan" in problem.message
    assert problem.line == line_of(text, 'value="Laser"') - 1
    assert read(text, repair=True).get_body_list() == ["Cart", "Camera"]


def test_cyclic_constraints_that_close_load_with_a_note_and_every_search_ends():
    bodies = [miro_body(name, miro_frame("a"), miro_frame("b")) for name in "XYZ"]
    joints = [miro_constraint(f"C{n}", f"{a}:b", f"{b}:a") for n, (a, b) in enumerate(("XY", "YZ", "ZX"))]
    text = miro(bodies, joints)
    model = read(text)
    (problem,) = model.problems
    assert problem.severity is Severity.NOTE
    assert "closes a loop through" in problem.message
    for search in Search:
        assert model.find_path("Z:a", "X:a", search)


def test_repair_drops_a_bad_constraint_but_not_what_cannot_be_read():
    text = miro(constraints=[miro_constraint("C", "Cart:Mats", "Camera:Origin")])
    model = read(text, repair=True)
    assert model.get_body_list() == ["Cart"]
    assert all(problem.severity is not Severity.ERROR for problem in model.problems)
    with pytest.raises(GeometryError, match="Row2 has 3 numbers"):
        read(with_row("0 1 0"), repair=True)


def test_a_frame_name_of_60_kilobytes_is_cut_in_the_message():
    problem = only_problem(miro(constraints=[miro_constraint("C", "Cart:" + "x" * 60_000, "Camera:Origin")]))
    assert len(str(problem)) < 1000
