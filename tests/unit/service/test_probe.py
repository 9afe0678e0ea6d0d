"""Judging bus, clock and daemons: each finding has a grade, and the command that mends it."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.errors import BusError
from modelserver.service.probing.clock import ClockFacts, clock_findings
from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel, of_weight, worst
from modelserver.service.probing.probe import BusFacts, Interface, UdpAddress, bus_findings, udp_address
from modelserver.service.probing.servers import DiscoveredServers, Server, server_findings
from modelserver.service.probing.start import probe, tell
from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.provider import RECEIVE_BUFFER_BYTES, resolve_url

LO = Interface("lo", multicast=True, loopback=True)
ETH = Interface("eth0")
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
    assert udp_address(url) == expected


@given(st.text())
def test_given_any_text_then_it_is_an_address_or_none(text: str) -> None:
    found = udp_address(f"udpm://{text}")
    assert found is None or isinstance(found.port, int)


# --- the bus ------------------------------------------------------------------------------------------------


def test_given_all_well_then_nothing_is_to_be_mended() -> None:
    findings = bus_findings(WELL)
    assert worst(findings) is DiagnosisLevel.OK
    assert not any(each.command for each in findings)


def test_given_another_provider_then_it_is_said_that_nothing_was_looked_at() -> None:
    (found,) = bus_findings(BusFacts("memq://\x1b[2J", None))
    assert found.grade is DiagnosisLevel.NOTE
    assert "\x1b" not in found.seen


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
            replace(WELL, heard=False),
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
def test_given_something_wrong_with_the_bus_then_it_is_graded_and_the_command_mends_it(
    facts: BusFacts, subject: str, grade: DiagnosisLevel, command: str
) -> None:
    found = about(bus_findings(facts), subject)
    assert (found.grade, found.command) == (grade, command)
    assert found.why
    assert worst(bus_findings(facts)) is grade


def test_given_long_messages_that_are_lost_then_the_buffer_is_named() -> None:
    found = about(bus_findings(replace(WELL, heard_large=False)), "own message")
    assert (found.grade, "rmem_max" in found.command) == (DiagnosisLevel.WARNING, True)


def test_given_a_small_default_buffer_then_it_is_worth_knowing_and_no_more() -> None:
    findings = bus_findings(replace(WELL, buffer_default=212_992))
    assert worst(findings) is DiagnosisLevel.NOTE
    assert any("rmem_default=4194304" in each.command for each in findings)


def test_given_a_way_that_the_kernel_does_not_name_then_it_is_there_and_no_more_is_said() -> None:
    findings = bus_findings(replace(OUTWARD, interface=Interface("")))
    assert about(findings, "multicast route").grade is DiagnosisLevel.OK
    assert "leaves the machine, for its network" in about(findings, "reach").seen


def test_given_what_the_machine_does_not_tell_then_nothing_is_said_of_it() -> None:
    facts = BusFacts(DEFAULT_URL, UdpAddress(), LO, (LO,))
    assert {each.subject for each in bus_findings(facts)} == {"multicast route", "reach"}


@pytest.mark.parametrize(("ttl", "words"), [(0, "nothing leaves"), (1, "for its network"), (3, "past 2 routers")])
def test_given_a_ttl_then_how_far_it_reaches_is_told_with_the_interface(ttl: int, words: str) -> None:
    facts = replace(OUTWARD, address=UdpAddress(ttl=ttl))
    found = about(bus_findings(facts), "reach")
    assert words in found.seen
    assert (found.grade is DiagnosisLevel.NOTE) == (ttl > 0) == ("eth0" in found.seen)


# --- the daemon's part --------------------------------------------------------------------------------------


def test_given_a_bus_that_is_well_then_the_daemon_goes_on_without_a_notice() -> None:
    said: list[tuple[str, str]] = []
    tell(probe(DEFAULT_URL, lambda url: WELL), lambda subject, text: said.append((subject, text)))
    assert said == []


def test_given_a_bus_that_does_not_deliver_then_the_daemon_does_not_start_and_says_what_mends_it() -> None:
    with pytest.raises(BusError, match=r"own message: it does not come back.*iptables"):
        probe(DEFAULT_URL, lambda url: replace(WELL, heard=False))


def test_given_a_small_buffer_then_it_is_logged_and_noticed_until_the_end(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    said: list[tuple[str, str]] = []
    facts = replace(WELL, buffer=212_992, dropped=5, interface=ETH)
    tell(probe(DEFAULT_URL, lambda url: facts), lambda subject, text: said.append((subject, text)))
    ((subject, text),) = said
    assert subject == "bus"
    assert "rmem_max" in text
    # what others lost is not told, and a note is no warning
    assert "5 packets" not in text
    assert [each.levelname for each in caplog.records].count("WARNING") == 1


# --- the clock ----------------------------------------------------------------------------------------------

NOW = 1_800_000_000_000_000


def test_given_a_synchronised_clock_then_it_is_well_and_its_error_told() -> None:
    (found,) = clock_findings(ClockFacts(NOW, True, 0.0125, 1e-5, 1.0, "chrony"), shared=True)
    assert (found.grade, "12.5 ms" in found.seen) == (DiagnosisLevel.OK, True)


@pytest.mark.parametrize(
    ("tool", "command"),
    [
        ("chrony", "sudo systemctl enable --now chrony"),
        ("ntp", "sudo systemctl enable --now ntp"),
        ("timesyncd", "sudo timedatectl set-ntp true"),
        ("", "sudo apt install chrony"),
    ],
)
@pytest.mark.parametrize(("shared", "grade"), [(True, DiagnosisLevel.WARNING), (False, DiagnosisLevel.NOTE)])
def test_given_a_clock_that_nobody_keeps_then_the_command_is_of_what_is_installed(
    tool: str, command: str, shared: bool, grade: DiagnosisLevel
) -> None:
    (found,) = clock_findings(ClockFacts(NOW, False, None, 0.0, 1.0, tool), shared)
    assert found.grade is grade
    assert found.command.startswith(command)


def test_given_a_clock_that_was_never_set_then_it_is_an_error() -> None:
    (found,) = clock_findings(ClockFacts(3_600_000_000, False), shared=False)
    assert found.grade is DiagnosisLevel.ERROR


@pytest.mark.parametrize("slewed", [3600.0, -3600.0, 0.01])
def test_given_a_step_while_it_is_watched_then_it_is_told(slewed: float) -> None:
    found = clock_findings(ClockFacts(NOW, True, None, slewed, 1.3, "chrony"), shared=False)
    assert (found[0].grade, f"{slewed:+.3f}" in found[0].seen) == (DiagnosisLevel.WARNING, True)


def test_given_a_clock_that_is_slewed_as_the_kernel_may_then_that_is_no_step() -> None:
    assert worst(clock_findings(ClockFacts(NOW, True, None, 5e-4, 1.3, "chrony"), shared=True)) is DiagnosisLevel.OK


def test_given_a_kernel_that_does_not_tell_then_it_is_said_so() -> None:
    (found,) = clock_findings(ClockFacts(NOW), shared=True)
    assert found.grade is DiagnosisLevel.NOTE


# --- the daemons --------------------------------------------------------------------------------------------

ONE = Server("pc", 10, "raptor", "1.0")


def test_given_one_daemon_then_it_is_well() -> None:
    (found,) = server_findings(DiscoveredServers((ONE,), 1), "", "1.0")
    assert (found.grade, "process 10" in found.seen) == (DiagnosisLevel.OK, True)


def test_given_none_then_it_is_a_note_with_how_to_start_it() -> None:
    (found,) = server_findings(DiscoveredServers((), 0), "B_", "1.0")
    assert (found.grade, "B_" in found.seen) == (DiagnosisLevel.NOTE, True)
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
    found = server_findings(answers, "", "1.0")[0]
    assert found.grade is DiagnosisLevel.ERROR
    assert found.command.startswith(command)


def test_given_daemons_of_other_vehicles_then_they_are_told_apart_by_their_prefix() -> None:
    found = server_findings(DiscoveredServers((ONE, Server("pc", 9, prefix="B_")), 1), "", "1.0")
    assert worst(found) is DiagnosisLevel.NOTE
    assert "'B_'" in found[-1].seen


def test_given_a_daemon_of_another_version_then_it_is_to_be_restarted() -> None:
    found = server_findings(DiscoveredServers((ONE,), 1), "", "2.0")
    assert worst(found) is DiagnosisLevel.WARNING


def test_given_a_stranger_who_calls_himself_oddly_then_it_is_escaped() -> None:
    found = server_findings(DiscoveredServers((Server("\x1b[31m\n" * 99, 1, version="\x07"),), 1), "", "1.0")
    assert all(each.seen.isprintable() and len(each.seen) < 400 for each in found)


# --- findings -----------------------------------------------------------------------------------------------


def test_given_findings_then_the_gravest_counts_and_those_of_weight_are_picked() -> None:
    findings = [
        Diagnosis(grade, grade.name, "x")
        for grade in (DiagnosisLevel.NOTE, DiagnosisLevel.ERROR, DiagnosisLevel.OK, DiagnosisLevel.WARNING)
    ]
    assert worst(findings) is DiagnosisLevel.ERROR
    assert [each.grade for each in of_weight(findings)] == [DiagnosisLevel.ERROR, DiagnosisLevel.WARNING]
    assert worst([]) is DiagnosisLevel.OK


def test_given_a_finding_then_its_text_has_what_why_and_how() -> None:
    text = str(Diagnosis(DiagnosisLevel.WARNING, "bus", "seen", "matters", "do it"))
    assert text == "bus: seen; matters. Mend it with: do it"
    assert str(Diagnosis(DiagnosisLevel.OK, "bus", "seen")) == "bus: seen"
