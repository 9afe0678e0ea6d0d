"""The daemon on an untrusted bus: signed commands, floods, publisher conflicts, and two vehicles on one network."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import FAST_HEALTH, Daemon
from support_lcm import Listener, wait_until
from support_samples import FORWARD, gps, imu
from support_signing import ALLOWED, KEY, envelope, write_test_key
from test_joint_motion import run_tool

import modelserver as ms
from modelserver.client.remote import Platform
from modelserver.messages import GetTransformation, ReloadModel, ReplyHeader, RequestHeader, SensorHeader
from modelserver.signing import MAX_CLOCK_LEAD_S, Key
from modelserver.wire.codec import decode, encode

SIGNED = "MODELSERVER_SIGNED"
RELOAD = "PLATFORM_RELOAD_MODEL"
StartDaemon = Callable[..., Daemon]


def now_utime() -> int:
    return time.time_ns() // 1000


def send_signed(daemon: Daemon, data: bytes, prefix: str = "") -> ReplyHeader:
    """Publish an envelope with a reload command; return the header of the reply to it."""
    listener = Listener(daemon.url, "REPLY_ME")
    daemon.publish(f"{prefix}{SIGNED}", data)
    assert listener.wait()
    header: ReplyHeader = decode("reload_model_reply_t", listener.received[0]).header
    return header


def sign_reload(utime: int, number: int = 1, prefix: str = "", key: Key = KEY, sender: str = "me") -> bytes:
    command = ReloadModel(RequestHeader(number, "REPLY_ME"), dry_run=True)
    return encode(envelope(command, utime, key, prefix, sender, number))


# --- signed commands ------------------------------------------------------------------------------------------------


def test_given_an_untrusted_sender_on_the_bus_then_it_cannot_change_the_service(
    start_signed: StartDaemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = start_signed()
    recorded = Listener(daemon.url, SIGNED)
    platform = daemon.platform()
    platform.reload_model(dry_run=True)
    assert recorded.wait()

    # a replay attack
    listener = Listener(daemon.url, platform.reply_channel)
    daemon.publish(SIGNED, recorded.received[0])
    assert listener.wait()
    replayed = decode("reload_model_reply_t", listener.received[0]).header
    assert replayed.status is ms.Status.FORBIDDEN
    assert "send a new one" in replayed.message
    # signed with a clock that is an hour off, either way
    for hours, word in ((-1, "before"), (1, "after")):
        signed = now_utime()
        header = send_signed(daemon, sign_reload(signed + hours * 3_600_000_000, 10 + hours))
        stated = re.search(rf"signed (\d+\.\d) s {word} ", header.message)
        assert header.status is ms.Status.FORBIDDEN
        assert stated is not None, header.message
        # the hour, and the time on the way, which grows on a busy machine
        delay = hours * (3600.0 - float(stated[1]))
        assert -0.1 < delay < (now_utime() - signed) * 1e-6 + 0.1
    # forged, for another vehicle, with another key, and with a flipped bit
    good = sign_reload(now_utime(), 20)
    daemon.publish(SIGNED, sign_reload(now_utime(), 21, key=Key("test", bytes(32))))
    daemon.publish(SIGNED, sign_reload(now_utime(), 22, prefix="V2_"))
    daemon.publish(SIGNED, sign_reload(now_utime(), 23, key=Key("other", bytes(32))))
    daemon.publish(SIGNED, good[:-1] + bytes([good[-1] ^ 1]))
    # without a signature
    monkeypatch.delenv("MODELSERVER_KEY_FILE")
    with pytest.raises(ms.ForbiddenError, match="not signed"):
        daemon.platform().reload_model()
    code, _, err = run_tool(daemon, "reload")
    assert code == 1
    assert "--key" in err
    found = daemon.wait_for_rejections(lambda found: found.get((RELOAD, "unsigned"), 0) >= 2)
    assert found == {
        (RELOAD, "replayed"): 1,
        (RELOAD, "stale"): 2,
        (RELOAD, "unsigned"): 2,
        (SIGNED, "bad_signature"): 3,
        (SIGNED, "unknown_key"): 1,
    }
    # and who has the key is served as before
    code, out, _ = run_tool(daemon, "reload", "--dry-run", "--key", str(tmp_path / "commands.key"))
    assert (code, "nothing would change" in out) == (0, True)
    assert daemon.health().handler_errors == 0
    assert "Traceback" not in daemon.log


def test_given_a_restart_then_what_was_signed_before_it_is_rejected_after_it(start_signed: StartDaemon) -> None:
    first = start_signed()
    # the largest permitted clock lead: the hardest case
    data = sign_reload(now_utime() + round(MAX_CLOCK_LEAD_S * 0.8e6))
    assert send_signed(first, data).status is ms.Status.OK
    assert first.end() == 0
    second = start_signed()
    header = send_signed(second, data)
    assert header.status is ms.Status.FORBIDDEN
    assert send_signed(second, sign_reload(now_utime(), 2)).status is ms.Status.OK


def test_given_two_keys_then_both_are_accepted_while_keys_are_changed(
    start_signed: StartDaemon, tmp_path: Path
) -> None:
    path = write_test_key(tmp_path)
    new = Key("new", b"the key that comes after")
    path.write_text(f"{path.read_text()}{new.name} {new.secret.hex()}\n")
    daemon = start_signed()
    for number, key in enumerate((KEY, new), 1):
        assert send_signed(daemon, sign_reload(now_utime(), number, key=key)).status is ms.Status.OK


def test_given_the_mode_command_then_it_signs_and_reports_why_it_is_denied(
    start_signed: StartDaemon, tmp_path: Path
) -> None:
    vehicle = FAST_HEALTH.replace("rate_hz: 50", "rate_hz: 50, state_hz: 20") + ALLOWED
    daemon = start_signed(vehicle + f"localization: {{mode_channel: LOCALIZATION_MODE, {FORWARD}}}\n")
    daemon.feed()
    code, out, err = run_tool(daemon, "mode", "no_gps", "-c", str(tmp_path / "vehicle.yaml"))
    assert (code, err) == (0, "")
    assert "now no_gps" in out
    other = write_test_key(tmp_path, Key("test", b"not the daemon's own key"), "other.key")
    code, _, err = run_tool(daemon, "mode", "full", "-c", str(tmp_path / "vehicle.yaml"), "--key", str(other))
    assert code == 1
    assert "stays in mode no_gps (bad_signature: " in err


def test_given_a_key_file_that_cannot_be_used_then_the_daemon_does_not_start_and_reports_why(
    start_daemon: StartDaemon, tmp_path: Path
) -> None:
    with pytest.raises(AssertionError, match="there is no key file"):
        start_daemon(FAST_HEALTH + ALLOWED)
    write_test_key(tmp_path).chmod(0o644)
    with pytest.raises(AssertionError, match="chmod 600"):
        start_daemon(FAST_HEALTH + ALLOWED)


# --- two vehicles ---------------------------------------------------------------------------------------------------


def test_given_two_vehicles_on_one_group_then_neither_receives_the_other(
    start_signed: StartDaemon, tmp_path: Path
) -> None:
    """One group, one key, two prefixes: samples, questions, commands and POSE stay with their vehicle."""
    daemons = {
        prefix: start_signed(
            f"{FAST_HEALTH}{ALLOWED}lcm: {{channel_prefix: {prefix}}}\n", tmp_path / prefix, prefix=prefix
        )
        for prefix in ("V1_", "V2_")
    }
    first = daemons["V1_"]
    listeners = {name: Listener(first.url, name) for name in ("POSE", "V1_POSE", "V2_POSE")}
    at = now_utime()
    for n in range(1, 21):
        first.publish("V1_IMU", encode(imu(at + n * 1000)))
        first.publish("V1_GPS", encode(gps(at + n * 1000, source="gps1")))
        first.publish("GPS", encode(gps(at + n * 1000, source="gps0")))
    first.health(lambda h: {each.channel for each in h.channels} == {"sensor:imu", "sensor:gps1"})
    assert not any(each.count for each in daemons["V2_"].health().channels)

    clients = {prefix: first.platform(channel_prefix=prefix) for prefix in daemons}
    for prefix, client in clients.items():
        assert client.get_body_list() == ["Cart", "Camera"]
        assert client.reload_model(dry_run=True).changes == ()
        assert daemons[prefix].health().vehicle == "cart"
    with pytest.raises(ms.NoServerError):
        first.platform(timeout=0.05).get_body_list()
    # a command signed for one vehicle is invalid for the other, though they share the key
    recorded = Listener(first.url, f"V1_{SIGNED}")
    clients["V1_"].reload_model(dry_run=True)
    assert recorded.wait()
    first.publish(f"V2_{SIGNED}", recorded.received[0])
    found = daemons["V2_"].wait_for_rejections(lambda found: bool(found))
    assert found == {(f"V2_{SIGNED}", "bad_signature"): 1}
    assert listeners["V1_POSE"].wait(3)
    assert listeners["V2_POSE"].wait(3)
    while listeners["POSE"].bus.handle_timeout(0):
        pass
    assert listeners["POSE"].received == []


# --- floods and publisher conflicts ---------------------------------------------------------------------------------


def test_given_one_clients_flood_then_another_is_answered_and_the_excess_is_counted_and_named(
    start_daemon: StartDaemon,
) -> None:
    daemon = start_daemon(FAST_HEALTH + "limits: {queued_requests: 64, client_hz: 50, request_share: 0.01}\n")
    daemon.feed()
    poses = Listener(daemon.url, "POSE")
    data = encode(GetTransformation(RequestHeader(1, "REPLY_FLOOD"), "Cart:Base", "World:UTM"))
    ended = threading.Event()

    def flood() -> None:
        bus = Listener(daemon.url, "NONE").bus
        while not ended.wait(0.005):
            for _ in range(20):
                bus.publish("PLATFORM_GET_TRANSFORMATION", data)

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        health = daemon.health(lambda h: any(subject == "requests" for subject, _ in h.warnings))
        (text,) = [text for subject, text in health.warnings if subject == "requests"]
        assert "client REPLY_FLOOD sends " in text
        with Platform(daemon.url, name="polite", timeout=10.0, retries=0) as polite:
            for _ in range(20):
                assert polite.get_body_list() == ["Cart", "Camera"]
        assert poses.wait(5)
    finally:
        ended.set()
        thread.join()
    assert daemon.wait_for_rejections(lambda found: True)["PLATFORM_GET_TRANSFORMATION", "overload"] > 0
    assert daemon.health(lambda h: all(subject != "requests" for subject, _ in h.warnings))
    assert daemon.health().handler_errors == 0


def test_given_a_publisher_conflict_then_it_is_reported_and_the_first_is_used(start_daemon: StartDaemon) -> None:
    daemon = start_daemon()
    begin = now_utime()
    for n in range(40):
        for source, number in (("imu", n), ("intruder", 500 + n)):
            sample = imu(begin + n * 5_000)
            header = SensorHeader(sample.header.utime, source, number)
            daemon.publish("IMU", encode(type(sample)(header, sample.angular_velocity, sample.specific_force)))
    health = daemon.health(lambda h: ("IMU", "publisher_conflict", 40) in h.rejected)
    assert {each.channel: each.count for each in health.channels if each.count} == {"sensor:imu": 40}
    assert dict(health.warnings)["channel IMU"].startswith("sources 'imu' and 'intruder' publish on IMU at once")
    assert wait_until(daemon.listener.bus, lambda: "'intruder'" in daemon.log)
    assert daemon.log.count("'intruder'") == 1
