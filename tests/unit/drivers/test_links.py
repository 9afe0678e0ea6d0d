"""Real links between two ends in one process, and their errors when they cannot be opened."""

from __future__ import annotations

import errno
import os
import socket
import termios
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import serial

from msdrivers.endpoint import (
    CanFrame,
    ModbusFailure,
    ModbusUnit,
    ReadRegisters,
    Registers,
    RegistersWritten,
    WriteRegisters,
)
from msdrivers.links import Link, LinkError, TcpLink, TcpServerLink
from msdrivers.links import can_bus as can_module
from msdrivers.links import serial_port as ports
from msdrivers.links import serial_port as serial_module
from msdrivers.links.can_bus import CanLink
from msdrivers.links.modbus import ModbusLink, ModbusServerLink
from msdrivers.links.serial_port import PtyLink, SerialLink

TIMEOUT_S = 10.0


def receive(link: Link[Any], count: int, other: Link[Any] | None = None) -> list[Any]:
    """Return what comes until there are `count` units, or bytes; `other` is polled meanwhile."""
    found: list[Any] = []
    end = time.monotonic() + TIMEOUT_S
    while sum(len(unit) if isinstance(unit, bytes) else 1 for unit in found) < count and time.monotonic() < end:
        if other is not None:
            other.poll(0.0)
        found += link.poll(0.05)
    return found


def wait_for_loss(link: Link[Any]) -> LinkError:
    """Return the error that a lost link raises."""
    with pytest.raises(LinkError) as caught:
        receive(link, 1 << 30)
    return caught.value


@pytest.fixture
def pty() -> Iterator[PtyLink]:
    link = PtyLink()
    link.open()
    yield link
    link.close()


@pytest.fixture
def server() -> Iterator[TcpServerLink]:
    link = TcpServerLink(0)
    link.open()
    yield link
    link.close()


def port_of(server: TcpServerLink | ModbusServerLink) -> int:
    return int(server.description.rpartition(":")[2])


# --- serial ports -------------------------------------------------------------------------------------------


def test_given_a_pty_when_opened_as_a_port_then_bytes_go_both_ways_unchanged(pty: PtyLink) -> None:
    port = SerialLink(pty.description, 38400)
    port.open()
    every = bytes(range(256))
    pty.send(every)
    assert b"".join(receive(port, 256)) == every
    port.send(every)
    assert b"".join(receive(pty, 256)) == every
    port.close()
    port.close()
    # a driver that goes is no loss for the device
    assert pty.poll(0.0) == ()


def test_given_a_port_whose_device_goes_then_the_line_is_lost_and_can_be_opened_when_it_is_back(tmp_path: Path) -> None:
    path = tmp_path / "gps"
    pty = PtyLink(link=path)
    pty.open()
    assert pty.description == str(path)
    port = SerialLink(str(path), 9600)
    port.open()
    pty.close()
    assert "unplugged" in str(wait_for_loss(port))
    port.close()
    assert not path.is_symlink()
    with pytest.raises(LinkError, match="there is no such port"):
        port.open()
    pty.open()
    port.open()
    pty.send(b"back")
    assert b"".join(receive(port, 4)) == b"back"
    port.close()
    pty.close()


def test_given_a_file_of_the_links_name_then_it_stays_and_the_line_is_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "precious.yaml"
    path.write_text("precious")
    pty = PtyLink(link=path)
    with pytest.raises(LinkError, match=r"precious.yaml: there is a file of that name, and it stays; give another"):
        pty.open()
    pty.close()
    assert path.read_text() == "precious"


def test_given_a_link_that_no_emulator_made_then_it_stays(tmp_path: Path) -> None:
    path = tmp_path / "gps"
    path.symlink_to(tmp_path)
    pty = PtyLink(link=path)
    with pytest.raises(LinkError, match=f"a link to {tmp_path} that no emulator made, and it stays"):
        pty.open()
    pty.close()
    assert path.readlink() == tmp_path


@pytest.mark.parametrize("left", ["/dev/pts/999999", "/dev/nowhere"])
def test_given_a_link_that_was_left_behind_then_it_is_taken_over(left: str, tmp_path: Path) -> None:
    path = tmp_path / "gps"
    path.symlink_to(left)
    pty = PtyLink(link=path)
    pty.open()
    assert path.is_char_device()
    pty.close()
    assert not path.is_symlink()


def test_given_a_link_in_use_when_another_emulator_wants_it_then_the_user_is_named_and_both_stay_as_they_are(
    tmp_path: Path,
) -> None:
    path = tmp_path / "gps"
    first, second = PtyLink(link=path), PtyLink(link=path)
    first.open()
    with pytest.raises(LinkError, match=rf"gps is in use: by process {os.getpid()} \(.*; end it"):
        second.open()
    second.close()
    assert path.is_char_device()
    first.close()


def test_given_a_link_that_another_has_taken_over_then_it_is_left_to_that_one(tmp_path: Path) -> None:
    path = tmp_path / "gps"
    pty = PtyLink(link=path)
    pty.open()
    path.unlink()
    path.symlink_to("/dev/null")
    pty.close()
    assert str(path.readlink()) == "/dev/null"


def test_given_a_port_in_use_then_the_process_is_named(pty: PtyLink) -> None:
    first, second = SerialLink(pty.description, 9600), SerialLink(pty.description, 9600)
    first.open()
    with pytest.raises(LinkError) as caught:
        second.open()
    assert caught.value.what == f"{pty.description} is in use"
    assert f"process {os.getpid()}" in caught.value.reason
    first.close()


@pytest.mark.parametrize("number", [errno.EACCES, errno.EPERM])
@pytest.mark.parametrize(
    ("group", "mode", "expected"),
    [
        (20, 0o660, "it belongs to group dialout: sudo usermod -aG dialout operator, then log in again"),
        (0, 0o660, "no group but root's may use it: write KERNEL=="),
        (20, 0o600, "no group but root's may use it: write KERNEL=="),
        (20, 0o620, 'GROUP="dialout", MODE="0660" into /etc/udev/rules.d/99-serial.rules, sudo usermod -aG dialout'),
    ],
)
def test_given_no_permission_then_the_fix_is_reported_how_to_get_it(
    number: int, group: int, mode: int, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise serial.SerialException(number, "could not open port")

    monkeypatch.setattr(serial_module.serial, "Serial", fail)
    owned = os.stat_result((mode, 0, 0, 1, 0, group, 0, 0, 0, 0))
    monkeypatch.setattr(ports, "get_owner", lambda _: (owned, "dialout"))
    monkeypatch.setattr(ports.getpass, "getuser", lambda: "operator")
    with pytest.raises(LinkError) as caught:
        SerialLink("/dev/ttyUSB0", 9600).open()
    assert caught.value.reason == "permission denied"
    assert expected in caught.value.fix


@pytest.mark.parametrize(
    ("wanted", "near"),
    [
        ("/dev/ttyUBS9", "; nearest: /dev/ttyUSB8"),
        ("/dev/ttyUSB0", "; nearest: /dev/ttyUSB8"),
        # there is always a ttyS0: no help for who misses an adapter
        ("/dev/ttyACM0", ""),
    ],
)
def test_given_a_missing_port_then_those_of_its_name_are_reported(
    wanted: str, near: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [ports.PortInfo("/dev/ttyUSB8", "adapter", ""), ports.PortInfo("/dev/ttyS0", "", "")]
    monkeypatch.setattr(ports, "find_ports", lambda: found)
    monkeypatch.setattr(ports.glob, "glob", lambda _: [])
    with pytest.raises(LinkError) as caught:
        SerialLink(wanted, 9600).open()
    assert caught.value.fix == f"plug it in; modelserver driver --list shows what is there{near}"


def test_given_adapters_with_an_id_then_a_missing_port_names_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "find_ports", list)
    monkeypatch.setattr(ports.glob, "glob", lambda _: ["/dev/serial/by-id/usb-FTDI"])
    assert ports.suggest_ports("/dev/ttyUSB0") == ("/dev/serial/by-id/usb-FTDI",)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("/usr/bin/python3", "/usr/bin/modelserver", "driver", "gps"), "process 7 (modelserver driver gps)"),
        (("/usr/bin/python3", "-c", "main()", "driver", "gps"), "process 7 (python driver gps)"),
        (("/usr/sbin/gpsd", "-n", "/dev/ttyUSB0"), "process 7 (gpsd -n /dev/ttyUSB0)"),
        (("x" * 100,), f"process 7 ({'x' * 60}...)"),
        (("",), "process 7 (kworker)"),
    ],
)
def test_given_a_process_then_its_command_line_is_shown(words: tuple[str, ...], expected: str, tmp_path: Path) -> None:
    process = tmp_path / "7"
    process.mkdir()
    (process / "cmdline").write_text("\0".join(words) + "\0")
    (process / "comm").write_text("kworker\n")
    assert ports._describe_process(process) == expected


def test_given_a_port_whose_settings_are_rejected_then_it_is_a_link_error(
    monkeypatch: pytest.MonkeyPatch, pty: PtyLink
) -> None:
    def fail(*_: object) -> None:
        # no OSError, and pyserial lets it through
        raise termios.error(errno.EINVAL, "Invalid argument")

    monkeypatch.setattr(termios, "tcsetattr", fail)
    with pytest.raises(LinkError, match="its settings are rejected: Invalid argument; is it a serial port"):
        SerialLink(pty.description, 9600).open()


def test_given_a_file_that_is_no_port_then_it_is_a_link_error(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("")
    with pytest.raises(LinkError):
        SerialLink(str(path), 9600).open()


def test_given_the_ports_of_this_machine_then_each_can_be_shown() -> None:
    assert all(port.path and port.description for port in ports.find_ports())


def test_given_a_board_then_its_present_uarts_are_listed_after_those_of_pyserial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder stands for /dev and sysfs: of the 8250 ports only ttyS0 has hardware, and console is no UART."""
    devices, kernel = tmp_path / "dev", tmp_path / "tty"
    types = {
        "ttyTHS1": "20",
        "ttymxc2": "62",
        "ttyAMA10": "30",
        "ttySC0": "84",
        "ttyLP3": "91",
        "ttyS0": "4",
        "ttyS1": "0",
    }
    for name, kind in {**types, "ttyGS0": "4", "ttyS9": ""}.items():
        (kernel / name).mkdir(parents=True)
        (kernel / name / "type").write_text(f"{kind}\n")
        devices.mkdir(exist_ok=True)
        (devices / name).touch()
    (devices / "ttySclk").touch()
    monkeypatch.setattr(ports, "DEVICES", devices)
    monkeypatch.setattr(ports, "KERNEL_DEVICES", kernel)
    monkeypatch.setattr(ports.list_ports, "comports", list)
    found = ports.find_ports()
    present = ["ttyAMA10", "ttyLP3", "ttyS0", "ttySC0", "ttyTHS1", "ttymxc2"]
    assert [Path(port.path).name for port in found] == present
    assert {port.description for port in found} == {"UART of the board"}


def test_given_the_unit_of_a_driver_then_it_may_use_the_ports_that_are_listed() -> None:
    unit = (Path(__file__).parents[3] / "config" / "systemd" / "modelserver-driver@.service").read_text()
    allowed = {line.removeprefix("DeviceAllow=char-") for line in unit.splitlines() if line.startswith("DeviceAllow=")}
    assert allowed == {f"{name} rw" for name in (*ports.BOARD_UARTS, "ttyUSB", "ttyACM")}


# --- TCP ----------------------------------------------------------------------------------------------------


def test_given_a_server_when_called_then_bytes_go_both_ways_and_a_later_caller_takes_over(
    server: TcpServerLink,
) -> None:
    server.send(b"no client is there")
    first, second = TcpLink("127.0.0.1", port_of(server)), TcpLink("127.0.0.1", port_of(server))
    first.open()
    first.send(b"hello")
    assert b"".join(receive(server, 5)) == b"hello"
    server.send(b"back")
    assert b"".join(receive(first, 4)) == b"back"
    second.open()
    second.send(b"me too")
    assert b"".join(receive(server, 6)) == b"me too"
    assert "gone" in str(wait_for_loss(first))
    assert server.clients_accepted == 2
    for link in (first, second):
        link.close()


def test_given_a_caller_who_goes_then_the_server_waits_for_another(server: TcpServerLink) -> None:
    for word in (b"one", b"two"):
        link = TcpLink("127.0.0.1", port_of(server))
        link.open()
        link.send(word)
        assert b"".join(receive(server, 3)) == word
        link.close()


def test_given_a_line_that_is_open_when_opened_again_then_it_stays_as_it_is(server: TcpServerLink) -> None:
    driver = TcpLink("127.0.0.1", port_of(server))
    driver.open()
    server.poll(1.0)
    server.open()
    server.send(b"still here")
    assert driver.poll(1.0) == (b"still here",)
    driver.close()


def test_given_nobody_listens_then_it_is_reported_and_a_port_in_use_is_named(server: TcpServerLink) -> None:
    with pytest.raises(LinkError, match=f"port {port_of(server)} is in use"):
        TcpServerLink(port_of(server)).open()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(LinkError, match="nothing listens there"):
        TcpLink("127.0.0.1", port).open()


@pytest.mark.parametrize("host", ["a..b", "x" * 70 + ".lan"])
def test_given_an_address_that_is_none_then_it_is_a_link_error(host: str) -> None:
    with pytest.raises(LinkError, match="look at address"):
        TcpLink(host, 3001).open()


def test_given_a_line_that_is_not_open_then_it_is_a_link_error() -> None:
    links: Sequence[Link[bytes]] = (TcpLink("127.0.0.1", 1), TcpServerLink(0), PtyLink(), SerialLink("/dev/x", 9600))
    for link in links:
        with pytest.raises(LinkError):
            link.poll(0.0)
        link.close()


# --- CAN ----------------------------------------------------------------------------------------------------


@pytest.fixture
def multicast() -> Iterator[str]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return f"239.74.163.2:{port}"


def test_given_a_bus_then_frames_and_error_frames_come_as_they_were_sent(multicast: str) -> None:
    one, two = CanLink(multicast, "udp_multicast"), CanLink(multicast, "udp_multicast")
    one.open()
    two.open()
    frames = [
        CanFrame(0x123, b"\x01\x02"),
        CanFrame(0x1ABCDEF0, b"12345678", is_extended=True),
        CanFrame(0x40, b"", is_error=True),
        CanFrame(0x7FF, bytes(64)),
    ]
    for frame in frames:
        one.send(frame)
    found = receive(two, 4)
    assert found == frames
    assert found[2].is_bus_off
    one.close()
    two.close()


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (errno.ENODEV, "there is no such network interface"),
        (errno.ENETDOWN, "sudo ip link set can7 up"),
        (errno.ENOBUFS, "not acknowledged"),
        (errno.EPERM, "permission denied"),
        (errno.EAFNOSUPPORT, "sudo modprobe -a can can_raw"),
        (-2, "python-can's documentation"),
    ],
)
def test_given_an_interface_that_cannot_be_used_then_the_fix_is_reported(
    number: int, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(**_: object) -> None:
        raise OSError(number, "name or service not known" if number < 0 else os.strerror(number))

    monkeypatch.setattr(can_module.can, "Bus", fail)
    with pytest.raises(LinkError, match=expected):
        CanLink("can7").open()


def test_given_a_mistyped_interface_then_the_nearest_is_reported() -> None:
    with pytest.raises(LinkError, match="write socketcan"):
        CanLink("can0", "soketcan").open()


@pytest.mark.parametrize(
    ("channel", "interface", "expected"),
    [
        ("can0", "udp_multicast", "GROUP:PORT"),
        ("239.74.163.9", "socketcan", "modelserver emulate --interface udp_multicast"),
    ],
)
def test_given_a_channel_of_another_interface_then_it_is_named(channel: str, interface: str, expected: str) -> None:
    with pytest.raises(LinkError, match=expected):
        CanLink(channel, interface).open()


def test_given_a_bus_that_cannot_be_opened_then_python_can_logs_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    for _ in range(3):
        with pytest.raises(LinkError):
            CanLink("can9").open()
    assert not caplog.records


# --- Modbus -------------------------------------------------------------------------------------------------


@pytest.fixture
def modbus(server: TcpServerLink) -> Iterator[tuple[ModbusLink, ModbusServerLink]]:
    device = ModbusServerLink(server)
    driver = ModbusLink(TcpLink("127.0.0.1", port_of(server)), 7)
    driver.open()
    yield driver, device
    driver.close()


def test_given_requests_then_each_has_its_reply_in_any_order(modbus: tuple[ModbusLink, ModbusServerLink]) -> None:
    driver, device = modbus
    requests: list[ModbusUnit] = [
        ReadRegisters(5, 3, "input", 70_001),
        ReadRegisters(6, 2, transaction=70_002),
        WriteRegisters(9, (1, 2, 65_535), 70_003),
    ]
    for request in requests:
        driver.send(request)
    came = receive(device, 3)
    assert came[0] == ReadRegisters(5, 3, "input", 70_001 & 0xFFFF)
    assert came[2] == WriteRegisters(9, (1, 2, 65_535), 70_003 & 0xFFFF)
    numbers = [unit.transaction for unit in came]
    device.send(RegistersWritten(9, 3, numbers[2]))
    device.send(ModbusFailure(code=2, transaction=numbers[1]))
    device.send(Registers(5, (7, 8, 9), numbers[0]))
    written, failure, registers = receive(driver, 3)
    assert written == RegistersWritten(9, 3, 70_003)
    assert registers == Registers(5, (7, 8, 9), 70_001)
    assert (failure.code, failure.transaction) == (2, 70_002)
    assert "no such register" in failure.text


@pytest.mark.parametrize(
    ("request_bytes", "code"),
    [
        (bytes.fromhex("000100000002072b"), 1),  # a function that is not served
        (bytes.fromhex("00010000000607030000ffff"), 1),  # more registers than a message holds
    ],
)
def test_given_a_request_that_is_not_served_then_an_exception_is_the_answer(
    request_bytes: bytes, code: int, server: TcpServerLink
) -> None:
    device = ModbusServerLink(server)
    caller = TcpLink("127.0.0.1", port_of(server))
    caller.open()
    caller.send(request_bytes)
    reply = b"".join(receive(caller, 9, device))
    assert reply[:2] == b"\x00\x01"
    assert reply[7] == request_bytes[7] | 0x80
    assert reply[8] == code
    caller.close()


def test_given_bytes_that_are_no_modbus_then_the_driver_reports_it_and_the_device_hangs_up(
    server: TcpServerLink,
) -> None:
    driver = ModbusLink(TcpLink("127.0.0.1", port_of(server)), 1)
    driver.open()
    driver.send(ReadRegisters(1, 1, transaction=4))
    receive(server, 12)
    server.send(b"GET / HTTP/1.1\r\n")
    assert "not Modbus/TCP" in str(wait_for_loss(driver))
    driver.close()
    caller = TcpLink("127.0.0.1", port_of(server))
    caller.open()
    caller.send(b"GET / HTTP/1.1\r\n")
    device = ModbusServerLink(server)
    with pytest.raises(LinkError):
        receive(caller, 1, device)
    caller.close()


def test_given_a_message_in_pieces_then_it_is_put_together(server: TcpServerLink) -> None:
    device = ModbusServerLink(server)
    caller = TcpLink("127.0.0.1", port_of(server))
    caller.open()
    message = bytes.fromhex("000900000006010300050002") * 2
    found: list[ModbusUnit] = []
    for n in range(len(message)):
        caller.send(message[n : n + 1])
        found += device.poll(0.2)
    assert found == [ReadRegisters(5, 2, transaction=9)] * 2
    caller.close()
