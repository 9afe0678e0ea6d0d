"""Errors state place and fix, cross process borders, and cost little for a request from a stranger."""

from __future__ import annotations

import pickle

import pytest
from support_geometry import star

from modelserver import errors
from modelserver.errors import (
    ConfigError,
    GeometryError,
    Location,
    Problem,
    QueryError,
    Severity,
    Status,
    UnknownBodyError,
    UnknownFrameError,
    WireError,
    find_nearest_names,
    make_status_error,
    quote,
)
from modelserver.geometry import ModelBuilder, names

LONG = "x" * 60_000
ODD = [
    "",
    " ",
    ":",
    "::",
    "a:b:c",
    "\n",
    "\x00:\x1b[31m",
    "a\u202eb:c",
    "\ud800:x",
    "é:ü",
    "💥:💥",
    "%s:{0}",
    "'\"\\:x",
    LONG,
    f"{LONG}:{LONG}",
]


def test_a_problem_reads_as_one_line():
    problem = Problem(
        Severity.ERROR, "no body 'Camra'", Location("cart.xml", 12, "constraint C"), "write Camera", ("Camera",)
    )
    assert str(problem) == "cart.xml:12 (constraint C): error: no body 'Camra'; nearest: Camera; fix: write Camera"
    assert str(Problem(Severity.NOTE, "plain")) == "note: plain"
    assert str(Location("", 0, "body A")) == "body A"
    assert str(Location("", 7)) == "line 7"
    assert str(Location("a.xml")) == "a.xml"


@pytest.mark.parametrize(
    "error",
    [
        ConfigError([Problem(Severity.ERROR, "wrong"), Problem(Severity.WARNING, "odd")]),
        GeometryError([Problem(Severity.ERROR, "wrong", Location("a", 1, "b"), "fix", ("c",))]),
        WireError("short", "too few bytes"),
        UnknownBodyError("no body", ["A", "B"]),
    ],
)
def test_errors_survive_pickling(error):
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is type(error)
    assert str(back) == str(error)
    assert vars(back) == vars(error)


def test_each_status_but_ok_has_one_error_class_that_carries_it():
    for status in Status:
        if status is not Status.OK:
            error = make_status_error(status, "message", ["near"])
            assert error.status is status
            assert error.nearest == ("near",)
    assert type(make_status_error(99, "from a newer server")) is errors.ServerError
    every = {cls for cls in vars(errors).values() if isinstance(cls, type) and issubclass(cls, QueryError)}
    assert {type(make_status_error(status, "")) for status in Status} == every - {QueryError}


def test_nearest_names_finds_typing_mistakes_whatever_their_case():
    known = ["Raptor:CG", "Digiclops:ImagePlane", "FLEA:Origin", "FrontNoddingSICK:Origin"]
    for typed in ("Digiclops:ImagePlan", "digiclops:imageplane", "Digiclops:ImgaePlane", "DigiclopsImagePlane"):
        assert find_nearest_names(typed, known)[0] == "Digiclops:ImagePlane"
    assert find_nearest_names("FLEA:Orgin", known)[0] == "FLEA:Origin"
    assert find_nearest_names("zzz", known) == ()
    assert find_nearest_names("x", []) == find_nearest_names("", known) == find_nearest_names(LONG, known) == ()
    assert len(find_nearest_names("aaaa", [f"aaa{letter}" for letter in "bcdefgh"], count=2)) == 2


def test_nearest_names_keeps_its_quality_among_ten_thousand():
    known = [f"Hub:Mount{number:05d}" for number in range(9_999)] + ["Hub:FrontRail"]
    for typed, meant in (
        ("Hub:Muont01234", "Hub:Mount01234"),
        ("hub:mount04321", "Hub:Mount04321"),
        ("HubMount07531", "Hub:Mount07531"),
        ("Hub:FrontRial", "Hub:FrontRail"),
        ("Hub:FrontRails", "Hub:FrontRail"),
    ):
        assert find_nearest_names(typed, known)[0] == meant


@pytest.mark.parametrize("name", ODD)
def test_odd_names_are_rejected_in_a_short_message_fit_for_a_terminal_and_the_wire(name):
    builder = ModelBuilder()
    builder.add_body("A").add_frame("a")
    builder.add_body("B").add_frame("b")
    model = builder.build()
    for call in (
        lambda: model.get_transformation(name, "A:a"),
        lambda: model.get_transformation("A:a", f"A:{name}"),
        lambda: model.find_path(name, "A:a"),
        lambda: model.body(name),
        lambda: model.root.frame(name),
        lambda: model.frame(name),
    ):
        with pytest.raises((UnknownBodyError, UnknownFrameError)) as caught:
            call()
        assert len(str(caught.value)) < 400
        assert str(caught.value).isprintable()
        str(caught.value).encode()


@pytest.mark.parametrize("name", ODD)
def test_a_file_of_odd_names_gives_short_messages(name):
    builder = ModelBuilder()
    builder.add_body(name).add_frame(name)
    builder.add_body("A").add_frame(name).add_frame("a")
    builder.add_constraint(name, name, name)
    builder.add_constraint("c", name, f"A:{name}")
    _, problems = builder.check()
    _, repaired = builder.check(repair=True)
    for problem in problems + repaired:
        assert len(str(problem)) < 1200, problem
        str(problem).encode()


def test_names_in_files():
    for good in ("A", "Front_Nodding-SICK.2", "é", "x" * names.MAX_LENGTH):
        assert names.find_problem(good) == ""
    for bad, why in (
        ("", "empty"),
        ("a:b", "colon"),
        ("a b", "white space"),
        ("a\u00a0b", "white space"),
        ("a\x00", "printable"),
        ("a\u202e", "printable"),
        ("x" * (names.MAX_LENGTH + 1), "at most 200"),
    ):
        assert why in names.find_problem(bad)


def test_shown_is_quoted_escaped_and_cut():
    assert quote("a\n") == r"'a\n'"
    assert quote("x" * 100) == f"'{'x' * 80}'... (100 characters)"


@pytest.mark.slow
def test_a_file_in_which_everything_is_wrong_gives_each_problem_a_short_message():
    builder = star(4_000)
    for number in range(2_000):
        builder.add_constraint(f"Bad{number}", f"Hubb:Mount{number}", f"Hub:Mont{number}")
    _, problems = builder.check()
    assert len(problems) == 4_000
    assert max(len(str(problem)) for problem in problems) < 800


@pytest.mark.slow
def test_ten_thousand_orphans_are_sorted_out():
    builder = ModelBuilder()
    for number in range(5_000):
        builder.add_body(f"A{number}").add_frame("x")
        builder.add_body(f"B{number}").add_frame("x")
        builder.add_constraint(f"C{number}", f"A{number}:x", f"B{number}:x")
    model = builder.build()
    assert len(model.assemblies) == 5_000
