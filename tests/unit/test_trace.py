"""The ways of a GPS sample and of a query through the code, as `python -m benchmarks trace` finds them."""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence

import pytest

from benchmarks import trace
from modelserver.wire.codec import decode

Ways = dict[str, trace.Way]


@pytest.fixture(scope="module")
def ways() -> Ways:
    rig = trace.Rig()
    found = {"fix": rig.drive()}
    pose = decode("pose_transform_t", rig.bus.get_published("POSE")[-1])
    assert pose.transformation.is_valid
    return found | trace.trace_queries(rig)


def is_in_order(of: Sequence[str], files: Sequence[str]) -> bool:
    """Return whether files with these beginnings are among the files, in this order."""
    at = [next((n for n, path in enumerate(files) if path.startswith(each)), -1) for each in of]
    return -1 not in at and at == sorted(at)


def test_given_a_fix_then_its_way_leads_from_the_driver_by_codec_and_core_to_the_filter(ways: Ways) -> None:
    stations = ("drivers/msdrivers/", "modelserver/wire/codec", "modelserver/core/", "modelserver/estimation/filter/")
    assert is_in_order(stations, list(ways["fix"]))


def test_given_a_query_then_its_way_leads_from_the_client_by_the_loop_to_the_view(ways: Ways) -> None:
    for name in ("query, static, first seen", "query, World now"):
        stations = ("modelserver/client/", "modelserver/server/loop", "modelserver/core/", "modelserver/query/view")
        assert is_in_order(stations, list(ways[name])), ways[name]
    static, world = (set(ways[name]) for name in ("query, static, first seen", "query, World now"))
    assert any("estimation" in path for path in world)
    assert not any("estimation" in path for path in static)


def test_given_a_way_then_its_files_define_its_functions(ways: Ways) -> None:
    for way in ways.values():
        for path, functions in way.items():
            tree = ast.parse((trace.ROOT / path).read_text(encoding="utf-8"))
            defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
            # a dataclass and a NamedTuple have methods that no file defines
            assert {name.rpartition(".")[2] for name in functions} <= defined | {"__init__", "__new__"}


def test_given_the_pictures_of_the_ways_then_each_station_is_on_its_way(ways: Ways) -> None:
    page = (trace.ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    fix, query = (
        re.findall(r"^ │  ([\w.]+) ", each, re.MULTILINE) for each in re.findall(r"```text\n(.*?)```", page, re.S)
    )
    for name, stations in (("fix", fix), ("query, static, first seen", query), ("query, World now", query)):
        functions = {each for of_file in ways[name].values() for each in of_file}
        assert 8 <= len(stations) <= 12
        assert set(stations) <= functions
