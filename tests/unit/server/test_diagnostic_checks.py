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
    DiscoveredServers,
    NetworkInterface,
    Server,
    evaluate_bus,
    evaluate_clock,
    evaluate_servers,
    filter_by_level,
    get_worst_level,
    probe_bus,
    report_findings,
)
from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.provider import RECEIVE_BUFFER_BYTES, UdpAddress, parse_udp_address, resolve_url

LO = NetworkInterface("lo", multicast=True, loopback=True)
ETH = NetworkInterface("eth0")
WELL = BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO, ETH), True, True, RECEIVE_BUFFER_BYTES, RECEIVE_BUFFER_BYTES, 0)
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
            replace(WELL, interface=replace(LO, multicast=False)),
            "multicast route",
            DiagnosisLevel.NOTE,
            "sudo ip link set lo multicast on",
        ),
        (
            replace(WELL, interface=ETH),
            "multicast route",
            DiagnosisLevel.NOTE,
            "sudo ip link set lo up multicast on && sudo ip route replace 239.255.76.67/32 dev lo",
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


def test_given_a_small_default_buffer_then_it_is_worth_knowing_and_no_more() -> None:
    findings = evaluate_bus(replace(WELL, buffer_default=212_992))
    assert get_worst_level(findings) is DiagnosisLevel.NOTE
    assert any("rmem_default=4194304" in each.command for each in findings)


def test_given_an_unknown_interface_of_the_route_then_the_route_is_reported_alone() -> None:
    findings = evaluate_bus(replace(OUTWARD, interface=NetworkInterface("")))
    assert about(findings, "multicast route").level is DiagnosisLevel.OK
    assert "messages leave the machine, for its network" in about(findings, "reach").observed


def test_given_unknown_facts_then_nothing_is_reported_of_them() -> None:
    facts = BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO,))
    assert {each.subject for each in evaluate_bus(facts)} == {"multicast route", "reach"}


@pytest.mark.parametrize(("ttl", "words"), [(0, "nothing leaves"), (1, "for its network"), (3, "past 2 routers")])
def test_given_a_ttl_then_its_reach_is_reported_with_the_interface(ttl: int, words: str) -> None:
    facts = replace(OUTWARD, address=UdpAddress(ttl=ttl))
    found = about(evaluate_bus(facts), "reach")
    assert words in found.observed
    assert (found.level is DiagnosisLevel.NOTE) == (ttl > 0) == ("eth0" in found.observed)


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


# --- the daemons --------------------------------------------------------------------------------------------

ONE = Server("pc", 10, "raptor", "1.0")


def test_given_one_daemon_then_it_is_well() -> None:
    (found,) = evaluate_servers(DiscoveredServers((ONE,), 1), "", "1.0")
    assert (found.level, "process 10" in found.observed) == (DiagnosisLevel.OK, True)


def test_given_none_then_it_is_a_note_with_how_to_start_it() -> None:
    (found,) = evaluate_servers(DiscoveredServers((), 0), "B_", "1.0")
    assert (found.level, "B_" in found.observed) == (DiagnosisLevel.NOTE, True)
    assert found.command.startswith("modelserver run")


@pytest.mark.parametrize(
    ("answers", "command"),
    [
        (DiscoveredServers((ONE, Server("pc", 11)), 2), "kill 11"),
        (DiscoveredServers((ONE, Server("other", 10, "raptor", "1.0")), 1), "kill 10"),
        (DiscoveredServers((ONE,), 2), "kill 10"),
        (DiscoveredServers((), 2), "systemctl stop modelserver"),
    ],
)
def test_given_two_daemons_then_it_is_an_error_and_one_is_to_be_stopped(
    answers: DiscoveredServers, command: str
) -> None:
    found = next(evaluate_servers(answers, "", "1.0"))
    assert found.level is DiagnosisLevel.ERROR
    assert found.command.startswith(command)


def test_given_servers_of_other_vehicles_then_their_prefixes_distinguish_them() -> None:
    found = tuple(evaluate_servers(DiscoveredServers((ONE, Server("pc", 9, prefix="B_")), 1), "", "1.0"))
    assert get_worst_level(found) is DiagnosisLevel.NOTE
    assert "'B_'" in found[-1].observed


def test_given_a_daemon_of_another_version_then_it_is_to_be_restarted() -> None:
    found = tuple(evaluate_servers(DiscoveredServers((ONE,), 1), "", "2.0"))
    assert get_worst_level(found) is DiagnosisLevel.WARNING


def test_given_an_odd_host_name_then_it_is_escaped() -> None:
    found = tuple(evaluate_servers(DiscoveredServers((Server("\x1b[31m\n" * 99, 1, version="\x07"),), 1), "", "1.0"))
    assert all(each.observed.isprintable() and len(each.observed) < 400 for each in found)


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
