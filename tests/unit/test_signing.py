"""Signed commands: the signed bytes and their example in the documentation, what is genuine, and what is fresh."""

from __future__ import annotations

import hashlib
import hmac
import re
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_signing import KEY, envelope

from modelserver.messages import Envelope, ReloadModel, RequestHeader
from modelserver.signing import (
    MAX_CLOCK_LEAD_S,
    MAX_SENDERS,
    Freshness,
    FreshnessResult,
    Key,
    check_freshness,
    compute_signature,
    encode_signed_bytes,
    has_valid_signature,
    sign,
)
from modelserver.wire.codec import decode, encode

WIRE_PAGE = Path(__file__).resolve().parents[2] / "docs" / "wire.md"
S = 1_000_000
NOW = 1_700_000_000_000_000
WINDOW = 5 * S
UP = 3600 * S
RELOAD = ReloadModel(RequestHeader(77, "REPLY_TEST"))

texts = st.text(st.characters(exclude_categories=("Cs",)), max_size=20)
int64 = st.integers(-(1 << 63), (1 << 63) - 1)
envelopes = st.builds(Envelope, texts, texts, int64, int64, texts, st.binary(max_size=64))


# --- the signature --------------------------------------------------------------------------------------------------


@given(key=st.binary(min_size=16, max_size=80), prefix=texts, made=envelopes)
def test_given_any_envelope_then_its_signature_is_hmac_sha256_over_what_the_page_states(
    key: bytes, prefix: str, made: Envelope
) -> None:
    def add_length(data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + data

    data = b"modelserver signed command, version 1\n"
    data += add_length(prefix.encode()) + add_length(made.key_name.encode()) + add_length(made.sender.encode())
    data += struct.pack(">qq", made.utime, made.counter) + add_length(made.channel.encode()) + add_length(made.payload)
    assert encode_signed_bytes(prefix, made) == data
    assert compute_signature(Key("k", key), prefix, made) == hmac.new(key, data, hashlib.sha256).digest()


@given(one=envelopes, other=envelopes, prefixes=st.tuples(texts, texts))
def test_given_two_envelopes_that_differ_then_their_signed_bytes_do(
    one: Envelope, other: Envelope, prefixes: tuple[str, str]
) -> None:
    same = (prefixes[0], one) == (prefixes[1], other)
    assert (encode_signed_bytes(prefixes[0], one) == encode_signed_bytes(prefixes[1], other)) is same


@given(st.tuples(texts, texts, texts), st.integers(0, 40))
def test_given_fields_whose_texts_run_together_alike_then_the_signed_bytes_differ(
    words: tuple[str, str, str], cut: int
) -> None:
    joined = "".join(words[:2])
    moved = Envelope(joined[:cut], joined[cut:], 1, 2, words[2], b"")
    made = Envelope(words[0], words[1], 1, 2, words[2], b"")
    assert (encode_signed_bytes("", made) == encode_signed_bytes("", moved)) is (made == moved)


def test_given_the_key_then_only_it_and_only_for_this_vehicle_is_genuine() -> None:
    made = envelope(RELOAD, NOW, prefix="V1_")
    assert has_valid_signature(KEY, "V1_", made)
    assert not has_valid_signature(KEY, "V2_", made)
    assert not has_valid_signature(KEY, "", made)
    assert not has_valid_signature(Key("test", bytes(32)), "V1_", made)
    assert not has_valid_signature(KEY, "V1_", made._replace(mac=made.mac[:31]))
    assert not has_valid_signature(KEY, "V1_", made._replace(mac=b""))


def test_given_a_key_then_its_secret_is_in_no_text() -> None:
    assert "secret" not in repr(KEY)
    assert KEY.secret.hex() not in f"{KEY} {KEY!r}"


def test_the_example_in_the_documentation_is_what_comes_out() -> None:
    text = WIRE_PAGE.read_text(encoding="utf-8")
    found = {name: value.replace("\n", "").replace(" ", "") for name, value in _blocks(text)}
    key = Key("example", bytes.fromhex(found["key"]))
    payload = encode(ReloadModel(RequestHeader(0x0123456789ABCDEF, "REPLY_EXAMPLE"), dry_run=True))
    made = sign(key, "V1_", Envelope("", "tool@console", NOW, 1, "PLATFORM_RELOAD_MODEL", payload))
    assert payload.hex() == found["payload"]
    assert encode_signed_bytes("V1_", made).hex() == found["signed bytes"]
    assert made.mac.hex() == found["mac"]
    assert encode(made).hex() == found["message"]
    assert decode("signed_t", encode(made)) == made


def _blocks(text: str) -> list[tuple[str, str]]:
    example = text[text.index("### Example") :]
    return re.findall(r"^(key|payload|signed bytes|mac|message):\n((?:    ?[0-9a-f ]+\n)+)", example, re.MULTILINE)


# --- freshness ------------------------------------------------------------------------------------------------------


def judge(
    known: Freshness, utime: int, now: int = NOW, up: int = UP, counter: int = 1, sender: str = "me"
) -> FreshnessResult:
    return check_freshness(known, envelope(RELOAD, utime, counter=counter, sender=sender), now, up, WINDOW)


@pytest.mark.parametrize("age_us", [0, 1, WINDOW, -S, -round(MAX_CLOCK_LEAD_S * 1e6)])
def test_given_a_command_within_the_window_then_it_is_fresh_once(age_us: int) -> None:
    first = judge(Freshness(), NOW - age_us)
    assert (first.reason, first.message) == ("", "")
    again = judge(first.freshness, NOW - age_us)
    assert again.reason == "replayed"
    assert again.freshness is first.freshness
    assert judge(first.freshness, NOW - age_us, counter=2).reason == ""


@pytest.mark.parametrize(
    ("age_s", "words"),
    [(5.1, "5.1 s before"), (3600.0, "3600.0 s before"), (-1.1, "1.1 s after"), (-3600.0, "3600.0 s after")],
)
def test_given_clocks_that_differ_then_it_is_stale_and_the_difference_is_named(age_s: float, words: str) -> None:
    found = judge(Freshness(), NOW - round(age_s * S))
    assert found.reason == "stale"
    assert words in found.message
    assert "chronyc" in found.message


@given(st.lists(st.tuples(st.integers(-WINDOW, S), st.integers(0, 3), st.sampled_from("abc")), max_size=30))
def test_given_any_commands_then_those_taken_of_a_sender_rise_strictly(given_: list[tuple[int, int, str]]) -> None:
    known, taken = Freshness(), dict[str, list[tuple[int, int]]]()
    for offset, counter, sender in given_:
        found = judge(known, NOW + offset, counter=counter, sender=sender)
        known = found.freshness
        if not found.reason:
            taken.setdefault(sender, []).append((NOW + offset, counter))
    for stamps in taken.values():
        assert stamps == sorted(set(stamps))


@given(st.integers(-10 * S, 10 * S), st.integers(0, 20 * S), st.integers(0, 20 * S))
def test_given_a_restart_then_nothing_is_taken_that_was_or_could_have_been_taken_before(
    offset: int, before_us: int, after_us: int
) -> None:
    """A command taken so long before the start is played again so long after it."""
    stamp = NOW - before_us + offset
    assert judge(Freshness(), stamp, now=NOW - before_us).reason or (
        judge(Freshness(), stamp, now=NOW + after_us, up=after_us).reason == "stale"
    )


def test_given_a_service_that_has_just_started_then_it_states_when_to_retry() -> None:
    found = judge(Freshness(), NOW, up=S // 4)
    assert found.reason == "stale"
    assert "send it again in 0.8 s" in found.message
    assert judge(Freshness(), NOW, up=round(MAX_CLOCK_LEAD_S * 1e6)).reason == ""


def test_given_a_clock_that_was_set_right_after_the_start_then_commands_are_taken_at_once() -> None:
    # it began an hour ahead; by the clock as it is now the start lies in the future
    assert judge(Freshness(), NOW, now=NOW, up=10 * S).reason == ""


def test_given_the_vehicles_clock_set_back_then_the_last_stamp_is_named_and_old_ones_stay_rejected() -> None:
    known = judge(Freshness(), NOW).freshness
    back = NOW - 3600 * S
    assert judge(known, NOW + S, now=back).reason == "stale"
    again = judge(known, back, now=back)
    assert again.reason == "replayed"
    assert "3600.0 s ahead of the vehicle's clock" in again.message
    # and when the clock comes to that time again, what was recorded then is still known
    assert judge(known, NOW, now=NOW + S).reason == "replayed"


def test_given_two_senders_then_each_has_its_own_row() -> None:
    known = judge(Freshness(), NOW, sender="a").freshness
    assert judge(known, NOW - S, sender="b").reason == ""
    assert judge(known, NOW - S, sender="a").reason == "replayed"


def test_given_endless_senders_then_the_state_is_bounded_and_nothing_is_accepted_twice() -> None:
    known = Freshness()
    for n in range(3 * MAX_SENDERS):
        known = judge(known, NOW + n, now=NOW + n, sender=f"sender{n}").freshness
        assert len(known.last) <= MAX_SENDERS
    for n in range(3 * MAX_SENDERS):
        assert judge(known, NOW + n, now=NOW + S, sender=f"sender{n}").reason == "replayed"
