"""Strangers on the bus: 100,000 messages that make no sense, and more questions than can be answered."""

from __future__ import annotations

import itertools
import random
import sys
import time
from pathlib import Path

from support_daemon import Trial, trial
from support_lcm import PATIENCE_S, started
from support_signing import ALLOWED, write_test_key
from support_wire import EXAMPLES

from modelserver.errors import WireError
from modelserver.wire.channels import CHANNELS, ChannelUse
from modelserver.wire.codec import decode, encode

MESSAGES = 100_000
PORTION = 500
EVERYTHING = {
    "\nsensors:\n": f"""
{ALLOWED}
sensors:
  aiding:
    map: {{type: absolute_pose, channel: ABSOLUTE_POSE}}
    eyes: {{type: relative_pose, channel: RELATIVE_POSE}}
    radio: {{type: range, channel: RANGE}}
""",
    '  mode_channel: ""': "  mode_channel: LOCALIZATION_MODE",
}
"""Whatever the service can listen to."""
QUERIES = 30_000
FLOOD = f"""
import sys, lcm
from modelserver.messages import GetTransformation, RequestHeader
from modelserver.wire.codec import encode
bus = lcm.LCM(sys.argv[1])
for n in range({QUERIES}):
    request = GetTransformation(RequestHeader(n, "REPLY_FLOOD"), "Digiclops:ImagePlane", "Raptor:CG")
    bus.publish("PLATFORM_GET_TRANSFORMATION", encode(request))
"""


def damaged(data: bytes, chance: random.Random) -> bytes:
    """A message with some of its bytes changed, left out or put in; the type's fingerprint stays, mostly."""
    kind = chance.randrange(5)
    at = chance.randrange(8, len(data)) if len(data) > 8 else 0
    if kind == 0:
        return chance.randbytes(chance.randrange(300))
    if kind == 1:
        return data[:at]
    if kind == 2:
        return data[:at] + chance.randbytes(chance.randrange(1, 40)) + data[at:]
    some = bytearray(data)
    for _ in range(chance.randrange(1, 9) if kind == 3 else 1):
        some[chance.randrange(8, len(some)) if len(some) > 8 else 0] = chance.choice((0, 1, 0x7F, 0x80, 0xFF, 0xF0))
    return bytes(some)


def pool(chance: random.Random) -> list[tuple[str, bytes, bool]]:
    """Messages for every channel that is heard, and whether each cannot be decoded."""
    found = []
    for channel in CHANNELS:
        if channel.way in (ChannelUse.BROADCAST, ChannelUse.REPORT) or channel.name in (
            "VEHICLE_STATUS",
            "VEHICLE_COMMAND",
        ):
            continue  # nobody listens
        good = encode(EXAMPLES[channel.type_name][-1])
        for _ in range(250):
            data = damaged(good, chance)
            try:
                decode(channel.type_name, data)
            except WireError:
                bad = True
            else:
                bad = False
            found.append((channel.name, data, bad))
    chance.shuffle(found)
    return found


def memory_kb(run: Trial) -> int:
    """What the daemon holds of the machine's memory."""
    status = Path(f"/proc/{run.process.pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0])


def test_given_100000_random_and_mutated_messages_then_it_serves_counts_them_and_does_not_grow(
    lcm_url: str, tmp_path: Path
) -> None:
    messages = pool(random.Random(11))
    undecodable, told = 0, 0
    memory: list[int] = []
    write_test_key(tmp_path)
    with trial(lcm_url, tmp_path, changes=EVERYTHING, more="limits: {history_s: 5}") as run:
        while told < MESSAGES:
            for channel, data, bad in (messages[(told + n) % len(messages)] for n in range(PORTION)):
                run.publish(channel, data)
                undecodable += bad
            told += PORTION
            # it is in step again when it has answered: what is more than it can take is not the matter here
            asked = time.monotonic()
            run.until(lambda asked=asked: run.answered_since(asked), "an answer")
            if told % (MESSAGES // 4) == 0:
                memory.append(memory_kb(run))
        health = run.until_health(lambda health: sum(each[2] for each in health.rejected) >= undecodable, "the counts")
        assert health.handler_errors == 0
        # LCM keeps what it once allocated for a channel that waited, up to 4 MiB, on a busy machine only now: such a
        # step comes in one quarter, a leak in each
        assert min(after - before for before, after in itertools.pairwise(memory)) < 512
        assert len(health.rejected) <= 257
        since = time.monotonic()
        run.until(lambda: run.answered_since(since), "an answer")
        run.assert_right()
        print(f"{told} messages, {undecodable} of them no message; {memory} kB")


def test_given_30000_questions_at_once_then_poses_go_on_and_what_is_too_much_is_refused_and_counted(
    lcm_url: str, tmp_path: Path
) -> None:
    with trial(lcm_url, tmp_path) as run, started((sys.executable, "-c", FLOOD, lcm_url), lcm_url) as flood:
        before = len(run.heard.poses)
        begun = time.monotonic()
        assert flood.wait(PATIENCE_S) == 0
        took = time.monotonic() - begun
        key = ("PLATFORM_GET_TRANSFORMATION", "load")
        health = run.until_health(lambda health: key in {each[:2] for each in health.rejected}, "refusals")
        poses = [at for at, _ in run.heard.poses[before:]]
        assert health.handler_errors == 0
        assert len(poses) > 10 * took
        since = time.monotonic()
        run.until(lambda: run.answered_since(since), "an answer")
        run.until(lambda: run.valid_since(since), "a valid pose")
        run.assert_right()
        print(
            f"{health.requests_answered} answered, {run.rejected[key]} refused, {len(poses) / took:.0f} poses a second"
        )
