"""Metrics for Prometheus: the rules of OpenMetrics 1.0, what the values are, and a real HTTP request."""

from __future__ import annotations

import json
import math
import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from support_wire import EXAMPLES

from modelserver.errors import ModelServerError
from modelserver.messages import DriverHealth, Health, Invalid
from mstools.terminal.health import CONTENT_TYPE, MAX_AGE_S, REQUEST_TIMEOUT_S, format_metrics, serve_metrics

BARE, FULL = EXAMPLES["health_t"]
DRIVERS: tuple[DriverHealth, ...] = EXAMPLES["driver_health_t"][1:]
ROOT = Path(__file__).parents[3]

Labels = tuple[tuple[str, str], ...]
Family = tuple[str, dict[tuple[str, Labels], float]]

SUFFIXES = {"counter": "_total", "info": "_info"}
NAME, LABEL = r"[a-zA-Z_:][a-zA-Z0-9_:]*", r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\\n]|\\[\\"n])*)"'
SAMPLE = re.compile(rf"({NAME})(?:\{{({LABEL}(?:,{LABEL})*)\}})? (\S+)")


def parse(text: str) -> dict[str, Family]:
    """Return type and samples of each family by the rules of OpenMetrics 1.0, which are asserted."""
    assert text.endswith("# EOF\n")
    families: dict[str, Family] = {}
    name = ""
    for line in text.removesuffix("# EOF\n").splitlines():
        if line.startswith("# "):
            _, keyword, family, rest = line.split(" ", 3)
            if keyword == "TYPE":
                # families are contiguous, each begins with its type
                assert family not in families
                assert not family.endswith(("_total", "_info", "_count", "_sum", "_bucket", "_created"))
                name = family
                families[name] = (rest, {})
            elif keyword == "UNIT":
                assert family == name
                assert name.endswith(f"_{rest}")
                assert families[name][0] not in ("info", "stateset")
                assert not families[name][1]
            else:
                assert (keyword, family) == ("HELP", name)
            continue
        matched = SAMPLE.fullmatch(line)
        assert matched, line
        kind, samples = families[name]
        assert matched[1] == name + SUFFIXES.get(kind, "")
        labels: Labels = tuple(re.findall(LABEL, matched[2] or ""))
        assert len(dict(labels)) == len(labels)
        value = float(matched[7])
        assert (matched[1], labels) not in samples, "a sample twice"
        if kind in ("stateset", "info"):
            assert value in (0.0, 1.0)
            assert kind == "info" or name in dict(labels)
        if kind == "counter":
            assert value >= 0.0
        if kind == "summary":
            assert 0.0 <= float(dict(labels)["quantile"]) <= 1.0
        samples[matched[1], labels] = value
    assert all(samples for _, samples in families.values())
    return families


def get(families: dict[str, Family], name: str, **labels: str) -> float:
    (value,) = (
        value
        for _, samples in families.values()
        for (found, there), value in samples.items()
        if found == f"modelserver_{name}" and dict(there) == labels
    )
    return value


def test_given_a_report_then_the_metrics_have_its_values() -> None:
    found = parse(format_metrics(FULL, 0.25, DRIVERS))
    assert get(found, "up") == get(found, "pose_valid") == 1.0
    assert get(found, "report_age_seconds") == 0.25
    assert get(found, "info", version="0.1.0", vehicle="raptor", model_revision="ab12") == 1.0
    assert get(found, "horizontal_protection_level_meters") == 1.5
    assert get(found, "heading_protection_level_radians") == 0.05
    assert get(found, "source_messages_total", source="sensor:gps") == 99.0
    assert get(found, "source_age_seconds", source="sensor:gps") == 0.4
    assert get(found, "source_silent", source="IMU") == 1.0
    assert get(found, "rejected_total", source="GPS", reason="truncated") == 4.0
    assert get(found, "tick_latency_seconds", quantile="0.99") == 0.001
    assert get(found, "state", modelserver_state="RUNNING") == 1.0
    assert get(found, "driver_phase", driver="gps", modelserver_driver_phase="STREAMING") == 1.0
    assert get(found, "driver_phase", driver="gps", modelserver_driver_phase="CLOSED") == 0.0
    assert get(found, "driver_counter_total", driver="gps", counter="rejected.checksum") == 3.0
    # its age is not known: the configured sensor has no sample yet
    assert "IMU" not in [dict(labels)["source"] for _, labels in found["modelserver_source_age_seconds"][1]]


def test_given_a_pose_that_may_not_be_used_then_the_reason_is_a_metric() -> None:
    found = parse(format_metrics(replace(FULL, invalid_reasons=Invalid.STALE_GPS), 0.0, ()))
    assert get(found, "pose_valid") == 0.0
    reasons = {
        dict(labels)["modelserver_pose_invalid_reason"]: value
        for (_, labels), value in found["modelserver_pose_invalid_reason"][1].items()
    }
    assert [name for name, value in reasons.items() if value] == ["STALE_GPS"]
    assert set(reasons) == {each.name for each in Invalid}


@pytest.mark.parametrize(("health", "age"), [(None, math.inf), (FULL, MAX_AGE_S + 0.1)])
def test_given_no_current_report_then_no_old_value_is_left(health: Health | None, age: float) -> None:
    found = parse(format_metrics(health, age, ()))
    assert set(found) == {"modelserver_up"}
    assert get(found, "up") == 0.0


def test_given_a_bare_report_and_names_of_strangers_then_the_format_stays_valid() -> None:
    parse(format_metrics(BARE, 0.0, EXAMPLES["driver_health_t"][:1]))
    source = 'a"b\\c\nd\u00e9'
    named = replace(FULL.channels[0], channel=source, rate_hz=math.inf, age=-math.inf)
    found = parse(format_metrics(replace(FULL, channels=(named,)), 0.0, ()))
    (((_, ((_, escaped),)), value),) = found["modelserver_source_rate_hertz"][1].items()
    assert (escaped, value) == ('a\\"b\\\\c\\nd\u00e9', math.inf)


@pytest.fixture
def address() -> Iterator[str]:
    server = serve_metrics("0", lambda: format_metrics(FULL, 0.0, DRIVERS))
    host, port = server.server_address[:2]
    yield f"http://{host!s}:{port}"
    server.shutdown()
    server.server_close()


def test_given_a_request_then_the_metrics_are_served_on_loopback(address: str) -> None:
    assert address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(f"{address}/metrics", timeout=10.0) as answer:
        assert answer.headers["Content-Type"] == CONTENT_TYPE
        assert get(parse(answer.read().decode()), "up") == 1.0
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{address}/other", timeout=10.0)


@pytest.mark.parametrize("given", ["x", "999999", "192.0.2.1:0", ""])
def test_given_an_address_that_cannot_be_used_then_the_error_has_the_fix(given: str) -> None:
    with pytest.raises(ModelServerError, match=r"cannot serve at .*; give a free port, or ADDRESS:PORT"):
        serve_metrics(given, str)


def test_given_the_dashboard_then_it_shows_metrics_that_exist() -> None:
    everything = replace(
        FULL,
        localization=replace(
            FULL.localization, horizontal_level=1.0, horizontal_limit=2.0, heading_level=0.1, heading_limit=0.2
        ),
    )
    names = {name for _, samples in parse(format_metrics(everything, 0.0, DRIVERS)).values() for name, _ in samples}
    dashboard = json.loads((ROOT / "config" / "grafana" / "modelserver.json").read_text())
    shown = {
        name
        for panel in dashboard["panels"]
        for target in panel["targets"]
        for name in re.findall(r"\b(modelserver_\w+)\{", target["expr"])
    }
    assert len(shown) > 15
    assert shown <= names
    assert "modelserver_up" in dashboard["templating"]["list"][1]["query"]["query"]
    places = [tuple(panel["gridPos"].values()) for panel in dashboard["panels"]]
    assert len(set(places)) == len(places)
    assert all(x + width <= 24 for x, _, width, _ in places)


def test_given_the_rules_then_the_parser_of_these_tests_rejects_what_breaks_them() -> None:
    good = format_metrics(FULL, 0.0, DRIVERS)
    for bad in (
        good.removesuffix("# EOF\n"),
        good.replace("poses_published_total", "poses_published"),
        good.replace("modelserver_memory_bytes bytes", "modelserver_memory_bytes meters"),
        good.replace('reason="stale"', 'reason="sta"le"'),
        good.replace("# EOF\n", "# TYPE modelserver_up gauge\n# EOF\n"),
    ):
        with pytest.raises(AssertionError):
            parse(bad)
    assert REQUEST_TIMEOUT_S > 0.0
