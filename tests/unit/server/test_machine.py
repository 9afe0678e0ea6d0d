"""Facts of this machine; unreadable ones are None."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from modelserver.errors import BusError
from modelserver.server import diagnostics as machine
from modelserver.server.diagnostics import read_gauges, read_resident_bytes
from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.provider import UdpAddress

UDP = """  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid timeout inode ref p drops
  1: 00000000:1DF3 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 1 2 0000000000000000 5
  2: 434CFFEF:1DF3 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 2 2 0000000000000000 7
  3: 00000000:0035 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 3 2 0000000000000000 99
"""

SNMP = """Tcp: ActiveOpens PassiveOpens
Tcp: 1 2
Udp: InDatagrams NoPorts InErrors OutDatagrams RcvbufErrors SndbufErrors
Udp: 1000 0 {errors} 1000 {lost} 0
"""


def folder(tmp_path: Path, lost: int = 100) -> Path:
    snmp = SNMP.format(errors=lost + 500, lost=lost)
    for name, text in (("net/udp", UDP), ("net/snmp", snmp)):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_given_this_machine_then_its_loopback_is_among_the_interfaces() -> None:
    found = {each.name: each for each in machine.list_interfaces()}
    assert found["lo"].loopback
    assert not any(each.loopback for name, each in found.items() if not name.startswith("lo"))


def test_given_a_group_then_the_way_to_it_is_one_of_the_interfaces() -> None:
    assert machine.find_interface(UdpAddress("no such host.")) is None
    way = machine.find_interface(UdpAddress())
    assert way in (None, "", *(each.name for each in machine.list_interfaces()))


ROUTES = """Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\tMTU\tWindow\tIRTT
eth0\t00000000\t010200C0\t0003\t0\t0\t100\t00000000\t0\t0\t0
wlan0\t00000000\t010200C0\t0003\t0\t0\t600\t00000000\t0\t0\t0
eth1\t000200C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0
"""


@pytest.mark.skipif(sys.byteorder != "little", reason="the table is written as in the memory of this machine")
@pytest.mark.parametrize(
    ("more", "way"),
    [
        ("", "eth0"),
        ("lo\t000000E0\t00000000\t0001\t0\t0\t0\t000000F0\t0\t0\t0\n", "lo"),
        ("lo\t000000E0\t00000000\t0000\t0\t0\t0\t000000F0\t0\t0\t0\n", "eth0"),
        ("can0 rubbish\n", "eth0"),
    ],
)
def test_given_the_kernels_routes_then_the_longest_that_fits_counts_and_of_equals_the_least_metric(
    tmp_path: Path, more: str, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "net").mkdir()
    (tmp_path / "net/route").write_text(ROUTES + more)
    # whether this machine has a route does not matter here
    monkeypatch.setattr(socket.socket, "connect", lambda self, to: None)
    monkeypatch.setattr(socket.socket, "getpeername", lambda self: ("239.255.76.67", 7667))
    assert machine.find_interface(UdpAddress(), tmp_path) == way
    assert machine.find_interface(UdpAddress(), tmp_path / "none") == ""


def test_given_a_buffer_asked_for_then_the_kernel_gives_it_or_less() -> None:
    assert 0 < machine.get_granted_buffer(100_000) <= 100_000 + 1
    assert machine.get_granted_buffer(1 << 30) < 1 << 30


def test_given_the_kernels_table_then_dropped_packets_on_the_port_are_summed(tmp_path: Path) -> None:
    assert machine.count_dropped(7667, folder(tmp_path)) == 12
    assert machine.count_dropped(7668, tmp_path) == 0
    assert machine.count_dropped(7667, folder(tmp_path, lost=0)) == 0, "a socket filter drops packets too"
    assert machine.count_dropped(7667, tmp_path / "none") is None


def test_given_a_url_then_its_facts_are_read_and_messages_tried(tmp_path: Path) -> None:
    asked: list[str] = []

    def delivery(url: str) -> tuple[bool, bool]:
        asked.append(url)
        return True, False

    facts = machine.read_bus_facts("udpm://127.0.0.1:7667?ttl=0&recv_buf_size=65536", delivery, folder(tmp_path))
    assert facts.interface is not None
    assert (facts.interface.name, facts.delivered, facts.delivered_large) == ("", True, False)
    assert (facts.buffer, facts.dropped) == (65536, 12)
    assert len(asked) == 1


def test_given_a_bus_that_cannot_be_joined_then_nothing_is_received(tmp_path: Path) -> None:
    def delivery(url: str) -> tuple[bool, bool]:
        raise BusError("no")

    assert machine.read_bus_facts("udpm://127.0.0.1:7667", delivery, tmp_path).delivered is False


def test_given_no_way_or_another_provider_then_nothing_is_tried(tmp_path: Path) -> None:
    def delivery(url: str) -> tuple[bool, bool]:
        raise AssertionError

    facts = machine.read_bus_facts("udpm://nowhere.:1", delivery, tmp_path)
    assert (facts.interface, facts.delivered) == (None, None)
    assert machine.read_bus_facts("memq://", delivery).address is None


def test_given_the_kernels_clock_then_it_is_synchronized_or_not_or_unknown() -> None:
    assert machine.is_clock_synchronized() in (True, False, None)


def test_given_this_process_then_its_gauges_are_read() -> None:
    found = read_gauges(4)
    assert found.queued == 4
    assert found.pid > 0
    assert 5_000_000 < found.memory < 10**12
    assert found.cpu_s > 0.0


def test_given_no_proc_then_memory_is_not_known(tmp_path: Path) -> None:
    assert read_resident_bytes(tmp_path / "none") == 0
    (tmp_path / "odd").write_text("12")
    assert read_resident_bytes(tmp_path / "odd") == 0


def test_given_the_default_bus_then_it_is_multicast() -> None:
    assert machine.read_bus_facts(DEFAULT_URL).address == UdpAddress()
