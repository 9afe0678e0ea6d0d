"""Checks of bus, clock and servers: level and fix of each finding."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.errors import BusError
from modelserver.server.diagnostics import (
    BusFacts,
    Diagnosis,
    DiagnosisLevel,
    NetworkInterface,
    evaluate_bus,
    evaluate_clock,
    filter_by_level,
    get_worst_level,
    probe_bus,
    report_findings,
)
from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.provider import RECEIVE_BUFFER_BYTES, UdpAddress, parse_udp_address, resolve_url

LO = NetworkInterface("lo", multicast=True, loopback=True)
ETH = NetworkInterface("eth0")
WELL = BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO, ETH), True, True, RECEIVE_BUFFER_BYTES, 0)
OUTWARD = replace(WELL, address=UdpAddress(ttl=1), interface=ETH)


def about(findings: Iterable[Diagnosis], subject: str) -> Diagnosis:
    return next(each for each in findings if each.subject == subject)


# --- the URL ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        (DEFAULT_URL, UdpAddress("239.255.76.67", 7667, 0)),
        (resolve_url(DEFAULT_URL), UdpAddress("239.255.76.67", 7667, 0, RECEIVE_BUFFER_BYTES)),
        ("udpm://", UdpAddress()),
        ("udpm://?ttl=2", UdpAddress(ttl=2)),
        ("udpm://239.1.2.3:4000?recv_buf_size=5&ttl=1", UdpAddress("239.1.2.3", 4000, 1, 5)),
        ("memq://", None),
        ("file:///tmp/x", None),
        ("udpm://239.1.2.3:x", None),
        ("udpm://239.1.2.3:4000?ttl=much", None),
        ("", None),
    ],
)
def test_given_a_url_then_group_port_and_ttl_are_read(url: str, expected: UdpAddress | None) -> None:
    assert parse_udp_address(url) == expected


@given(st.text())
def test_given_any_text_then_it_is_an_address_or_none(text: str) -> None:
    found = parse_udp_address(f"udpm://{text}")
    assert found is None or isinstance(found.port, int)


# --- the bus ------------------------------------------------------------------------------------------------


def test_given_a_working_bus_then_there_is_nothing_to_fix() -> None:
    findings = evaluate_bus(WELL)
    assert get_worst_level(findings) is DiagnosisLevel.OK
    assert not any(each.command for each in findings)


def test_given_another_provider_then_the_missing_check_is_reported() -> None:
    (found,) = evaluate_bus(BusFacts("memq://\x1b[2J", None))
    assert found.level is DiagnosisLevel.NOTE
    assert "\x1b" not in found.observed


@pytest.mark.parametrize(
    ("facts", "subject", "grade", "command"),
    [
        (
            replace(WELL, interface=None),
            "multicast route",
            DiagnosisLevel.ERROR,
            "sudo ip link set lo up multicast on && sudo ip route replace 239.255.76.67/32 dev lo",
        ),
        (
            replace(OUTWARD, interface=None),
            "multicast route",
            DiagnosisLevel.ERROR,
            "sudo ip route replace 239.255.76.67/32 dev eth0",
        ),
        (
            replace(OUTWARD, interface=None, interfaces=(LO,)),
            "multicast route",
            DiagnosisLevel.ERROR,
            "sudo ip link set lo up multicast on && sudo ip route replace 239.255.76.67/32 dev lo",
        ),
        (
            replace(OUTWARD, interface=replace(ETH, up=False)),
            "multicast route",
            DiagnosisLevel.ERROR,
            "sudo ip link set eth0 up",
        ),
        (
            replace(OUTWARD, interface=LO),
            "multicast route",
            DiagnosisLevel.WARNING,
            "sudo ip route replace 239.255.76.67/32 dev eth0",
        ),
        (
            replace(OUTWARD, interface=LO, interfaces=(LO,)),
            "multicast route",
            DiagnosisLevel.WARNING,
            "sudo ip route flush match 239.255.76.67 dev lo",
        ),
        (
            replace(WELL, delivered=False),
            "own message",
            DiagnosisLevel.ERROR,
            "sudo nft list ruleset; sudo iptables -I INPUT -d 239.255.76.67 -p udp -j ACCEPT",
        ),
        (
            replace(WELL, buffer=212_992),
            "receive buffer",
            DiagnosisLevel.WARNING,
            "sudo sysctl -w net.core.rmem_max=4194304 && "
            "echo 'net.core.rmem_max = 4194304' | sudo tee -a /etc/sysctl.d/60-modelserver.conf",
        ),
        (replace(WELL, dropped=17), "lost packets", DiagnosisLevel.WARNING, "sudo ss -uanmp 'sport = :7667'"),
    ],
)
def test_given_a_fault_of_the_bus_then_it_has_a_level_and_the_command_fixes_it(
    facts: BusFacts, subject: str, grade: DiagnosisLevel, command: str
) -> None:
    found = about(evaluate_bus(facts), subject)
    assert (found.level, found.command) == (grade, command)
    assert found.why
    assert get_worst_level(evaluate_bus(facts)) is grade


def test_given_long_messages_that_are_lost_then_the_buffer_is_named() -> None:
    found = about(evaluate_bus(replace(WELL, delivered_large=False)), "own message")
    assert (found.level, "rmem_max" in found.command) == (DiagnosisLevel.WARNING, True)


def test_given_an_unknown_interface_of_the_route_then_the_route_is_reported_alone() -> None:
    findings = evaluate_bus(replace(OUTWARD, interface=NetworkInterface("")))
    assert about(findings, "multicast route").level is DiagnosisLevel.OK


def test_given_unknown_facts_then_nothing_is_reported_of_them() -> None:
    facts = BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO,))
    assert {each.subject for each in evaluate_bus(facts)} == {"multicast route"}


# --- the daemon's part --------------------------------------------------------------------------------------


def test_given_a_working_bus_then_the_daemon_continues_without_a_warning() -> None:
    warnings: list[tuple[str, str]] = []
    report_findings(probe_bus(DEFAULT_URL, lambda url: WELL), lambda subject, text: warnings.append((subject, text)))
    assert warnings == []


def test_given_a_bus_that_does_not_deliver_then_the_daemon_does_not_start_and_reports_the_fix() -> None:
    with pytest.raises(BusError, match=r"own message: it does not come back.*iptables"):
        probe_bus(DEFAULT_URL, lambda url: replace(WELL, delivered=False))


def test_given_a_small_buffer_then_it_is_logged_and_a_lasting_warning(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    warnings: list[tuple[str, str]] = []
    facts = replace(WELL, buffer=212_992, dropped=5, interface=ETH)
    report_findings(probe_bus(DEFAULT_URL, lambda url: facts), lambda subject, text: warnings.append((subject, text)))
    ((subject, text),) = warnings
    assert subject == "bus"
    assert "rmem_max" in text
    # packets lost by others are not reported, and a note is no warning
    assert "5 packets" not in text
    assert [each.levelname for each in caplog.records].count("WARNING") == 1


# --- the clock ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("synchronized", "shared", "grade"),
    [
        (True, True, DiagnosisLevel.OK),
        (False, True, DiagnosisLevel.WARNING),
        (False, False, DiagnosisLevel.NOTE),
        (None, True, DiagnosisLevel.NOTE),
    ],
)
def test_given_a_clock_then_its_synchronization_counts_where_other_machines_are(
    synchronized: bool | None, shared: bool, grade: DiagnosisLevel
) -> None:
    found = evaluate_clock(synchronized, shared)
    assert (found.level, bool(found.command)) == (grade, synchronized is False)


# --- findings -----------------------------------------------------------------------------------------------


def test_given_findings_then_the_gravest_counts_and_those_of_weight_are_picked() -> None:
    findings = [
        Diagnosis(grade, grade.name, "x")
        for grade in (DiagnosisLevel.NOTE, DiagnosisLevel.ERROR, DiagnosisLevel.OK, DiagnosisLevel.WARNING)
    ]
    assert get_worst_level(findings) is DiagnosisLevel.ERROR
    assert [each.level for each in filter_by_level(findings)] == [DiagnosisLevel.ERROR, DiagnosisLevel.WARNING]
    assert get_worst_level([]) is DiagnosisLevel.OK


def test_given_a_finding_then_its_text_has_what_why_and_how() -> None:
    text = str(Diagnosis(DiagnosisLevel.WARNING, "bus", "seen", "matters", "do it"))
    assert text == "bus: seen; matters. Fix it with: do it"
    assert str(Diagnosis(DiagnosisLevel.OK, "bus", "seen")) == "bus: seen"
