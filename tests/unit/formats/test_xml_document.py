"""XML from strangers."""

import pytest
from support_formats import line_of, miro, miro_body, only_problem, problems_of, read

PROLOG = '<?xml version="1.0"?>\n<!-- a comment\n with <!DOCTYPE x [ -->\n'

BOMB = (
    '<!DOCTYPE config [\n<!ENTITY a "aaaaaaaaaa">\n'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">\n' for a, b in zip("abcdefghi", "bcdefghij", strict=True))
    + ']>\n<config><section><parameter name="&j;"/></section></config>'
)


@pytest.mark.parametrize(
    "doctype",
    [
        '<!DOCTYPE config SYSTEM "PolicyEditor_behaviour.dtd">',
        '<!DOCTYPE config PUBLIC "-//x//y" "http://localhost/x.dtd">',
        '<!DOCTYPE config [<!ENTITY secret SYSTEM "file:///etc/hostname">]>',
        "<!DOCTYPE config [ <!ELEMENT config ANY> ]>",
        "<!DOCTYPE config\n[]>",
    ],
)
def test_a_doctype_with_a_dtd_or_entities_is_rejected_at_its_line(doctype):
    problem = only_problem(PROLOG + doctype + "\n" + miro())
    assert problem.line == 4
    assert "DOCTYPE" in problem.message
    assert "<!DOCTYPE MiroConfigDocument>" in problem.fix


def test_a_bare_doctype_is_let_through():
    assert read(PROLOG + "<!DOCTYPE MiroConfigDocument>\n" + miro())


def test_an_entity_bomb_is_rejected():
    assert "entities" in only_problem(BOMB).message


def test_a_doctype_hidden_by_an_encoding_is_rejected():
    for encoding in ("utf-16", "utf-32"):
        assert only_problem(BOMB.encode(encoding)).severity == "error"
    hidden = BOMB.replace("<!", "+ADwAIQ-").encode()
    assert only_problem(b'<?xml version="1.0" encoding="UTF-7"?>' + hidden).severity == "error"


@pytest.mark.parametrize("length", [10, 100_000])
def test_a_long_prolog_is_read(length):
    assert read("<?a?>\n" * length + " " * length + "<!-- -->" * length + miro())


def test_an_unclosed_element_is_reported_with_its_line():
    text = miro().replace("</section>\n", "")
    problem = only_problem(text)
    assert "not well-formed" in problem.message
    assert problem.line == line_of(text, "</config>")
    assert "close every element" in problem.fix


@pytest.mark.parametrize(
    "content",
    [b"<", b"<config", b"<config>\0</config>", b"<\xff\xfe>", b"<?xml", b"<!--", b"<!DOCTYPE", b"<a>" * 5000, b"</a>"],
)
def test_broken_xml_is_a_problem_not_a_traceback(content):
    assert only_problem(content).severity == "error"


def test_a_file_named_xml_is_read_as_xml_whatever_it_begins_with():
    from modelserver.formats import parse_content

    (problem,) = parse_content(b"bodies:\n", "cart.xml").problems
    assert "not well-formed" in problem.message


@pytest.mark.parametrize(
    ("root", "message"),
    [
        ("<html><body/></html>", "the outermost element is html, not config"),
        ('<robot name="x"/>', "there is no link"),
        ("<sdf/>", "SDF"),
        ("<config/>", "there is no geometry in this file"),
        ("<config><config_group name='test'/></config>", "compile-time"),
    ],
)
def test_xml_that_is_no_geometry_is_recognized(root, message):
    problem = next(each for each in problems_of(root) if each.severity == "error")
    assert message in problem.message
    assert problem.line == 1
    assert problem.fix


def test_lines_past_65535_are_right_within_one():
    text = miro([miro_body("Cart"), miro_body("Camera"), "\n" * 70_000 + miro_body("Cart")], [])
    problem = next(each for each in problems_of(text) if each.severity == "error")
    assert abs(problem.line - text[: text.rindex('value="Cart"')].count("\n")) <= 1


def test_a_namespace_does_not_matter():
    assert read(miro().replace("<config>", '<config xmlns="urn:miro">'))
