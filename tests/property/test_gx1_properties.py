"""The 3DM-GX1's protocol on any values and any bytes."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from support_gx1 import Line, RepeatingDevice, rotating_samples

from msdrivers.devices.gx1 import (
    LAYOUTS,
    MEASUREMENTS,
    Gx1Driver,
    Gx1Packet,
    Gx1Settings,
    Gx1Stream,
    TickUnwrapper,
    decode_packet,
)
from msdrivers.emulate.imu import Gx1Emulator
from msdrivers.endpoint import MeasuredSample

words = st.integers(-32768, 32767)


@st.composite
def packets(draw: st.DrawFn) -> Gx1Packet:
    command = draw(st.sampled_from(sorted(LAYOUTS)))
    layout = LAYOUTS[command]
    values = draw(st.tuples(*[words] * layout.words))
    return Gx1Packet(command, values, draw(st.integers(0, 65535)) if layout.has_ticks else None)


@given(packets())
def test_given_any_reply_when_written_and_decoded_then_it_is_the_same(packet):
    raw = packet.to_bytes()
    assert decode_packet(raw, 0, packet.command) == packet


@given(packets(), st.data())
def test_given_any_reply_with_one_bit_changed_then_it_is_rejected(packet, data):
    raw = bytearray(packet.to_bytes())
    at = data.draw(st.integers(1, len(raw) - 1))
    raw[at] ^= 1 << data.draw(st.integers(0, 7))
    assert decode_packet(raw, 0, packet.command) is None


@given(st.lists(st.one_of(st.binary(max_size=40), packets().map(Gx1Packet.to_bytes)), max_size=12), st.data())
def test_given_any_split_of_the_bytes_then_the_replies_and_the_counters_are_the_same(parts, data):
    raw = b"".join(parts)
    whole, split = Gx1Stream(), Gx1Stream()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(raw)), max_size=20)))
    found = [packet for a, b in zip([0, *cuts], [*cuts, len(raw)], strict=True) for packet in split.feed(raw[a:b])]
    assert found == whole.feed(raw)
    assert split.counts == whole.counts


@given(st.binary(max_size=300), st.integers(0, 60_000))
def test_given_any_noise_before_a_stream_then_it_is_followed_within_three_messages(noise, first):
    parser = Gx1Stream()
    parser.set_commands(*MEASUREMENTS)
    parser.feed(noise)
    good = [Gx1Packet(0x31, tuple(range(9)), first + k) for k in range(6)]
    found = parser.feed(b"".join(packet.to_bytes() for packet in good))
    assert found[-3:] == good[-3:]


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 65535)), min_size=1, max_size=300))
def test_given_ticks_that_advance_with_the_time_then_the_count_is_their_sum(steps):
    watch = TickUnwrapper()
    watch.set_tick(0.01)
    at, total = 0, steps[0][1]
    first = watch.unwrap(total, at)
    assert first is not None
    begin = first - total
    for step, _ in steps:
        at += step * 10_000_000
        total += step
        assert watch.unwrap(total % 65_536, at) == begin + total


@given(st.lists(st.integers(0, 65535), min_size=2, max_size=60), st.integers(0, 10_000_000_000))
def test_given_any_ticks_then_the_count_never_goes_back(ticks, step):
    watch = TickUnwrapper()
    counts = [count for k, tick in enumerate(ticks) if (count := watch.unwrap(tick, k * step)) is not None]
    assert counts == sorted(counts)


@given(st.lists(st.binary(max_size=60), max_size=20))
def test_given_any_bytes_when_a_device_reads_them_then_it_answers_or_is_silent(parts):
    line = Line(RepeatingDevice(b""), Gx1Emulator(rotating_samples(seconds=1.0)))
    device = line.device
    device.on_open(line.now())
    for part in parts:
        line.now_ns += 20_000_000
        device.on_receive(part, line.now())
        device.on_timer(line.now())
    assert sum(device.counts.values()) <= sum(map(len, parts)) + 50


@settings(max_examples=20)
@given(st.integers(0, 2**32))
def test_given_any_bytes_when_the_driver_reads_them_then_nothing_is_published_and_nothing_fails(seed):
    rng = random.Random(seed)
    line = Line(
        Gx1Driver(Gx1Settings("imu")), RepeatingDevice(b"\0" * 60, 0.02), corrupt=lambda unit: rng.randbytes(len(unit))
    )
    line.run(12.0)
    assert not [output for output in line.samples if isinstance(output, MeasuredSample)]
