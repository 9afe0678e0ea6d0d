"""Parts of a reply: lost, twice, out of order, and of two answers to one question."""

from __future__ import annotations

import itertools
import random
from functools import cache

import numpy as np
import pytest
from support_moving import BASE, DEEP, SCAN, T0, UTM, S, view

from modelserver.client.remote import BatchReplyAssembler, concatenate
from modelserver.errors import WireError
from modelserver.messages import GetTransformations, PoseBatchReply, RequestHeader
from modelserver.query.answers import COVARIANCES_IN_PART, POSES_IN_PART, DeferredAnswer
from modelserver.query.batch import lookup_batch
from modelserver.query.view import complete
from modelserver.wire.codec import decode, encode

PAIRS = ((SCAN, UTM), (DEEP, BASE))
AT = T0 + np.arange(700, dtype=np.int64) * 1000


@cache
def encode_parts(covariance: bool = True, utime: int = T0 + S) -> tuple[bytes, ...]:
    request = GetTransformations(RequestHeader(5, "REPLY_ME"), PAIRS, tuple(AT.tolist()), with_covariance=covariance)
    return tuple(encode(part) for part in complete(DeferredAnswer(view(1.0), request, utime).work()))


def decode_part(data: bytes) -> PoseBatchReply:
    found = decode("get_transformations_reply_t", data)
    assert isinstance(found, PoseBatchReply)
    return found


def check(parts: BatchReplyAssembler) -> None:
    for (interest, reference), found in zip(PAIRS, parts.join(PAIRS, AT), strict=True):
        expected = complete(lookup_batch(view(1.0), interest, reference, AT))
        assert (found.frame_of_interest, found.frame_of_reference) == (interest, reference)
        assert np.array_equal(found.vectors, expected.vectors)
        assert found.covariances is not None
        assert np.array_equal(found.covariances, expected.covariances)
        for field in ("utimes", "status", "invalid", "quality", "epochs"):
            assert np.array_equal(getattr(found, field), getattr(expected, field)), field
        assert found.origin == expected.origin


def test_given_covariances_then_parts_fit_a_datagram() -> None:
    assert len(encode_parts()) == 2 * -(-len(AT) // COVARIANCES_IN_PART)
    assert len(encode_parts(False)) == 2 * -(-len(AT) // POSES_IN_PART)
    assert max(map(len, (*encode_parts(), *encode_parts(False)))) < 64_000


@pytest.mark.parametrize("seed", range(5))
def test_given_parts_in_any_order_and_twice_then_the_whole_is_the_same(seed: int) -> None:
    rng = random.Random(seed)
    order = list(encode_parts()) + rng.choices(encode_parts(), k=6)
    rng.shuffle(order)
    parts = BatchReplyAssembler(decode_part)
    done = [parts.add(each) for each in order]
    # whole when the last that was missing has come, and not before
    first = done.index(True)
    assert len({*order[: first + 1]}) == len(encode_parts())
    assert len({*order[:first]}) < len(encode_parts())
    check(parts)


def test_given_a_part_that_is_lost_then_it_is_not_whole_until_the_question_is_asked_again() -> None:
    parts = BatchReplyAssembler(decode_part)
    assert [parts.add(each) for each in encode_parts()[1:]] == [False] * (len(encode_parts()) - 1)
    again = encode_parts(utime=T0 + S + 1)
    assert [parts.add(each) for each in again] == [False] * (len(again) - 1) + [True]
    check(parts)


def test_given_two_answers_to_one_question_then_their_parts_are_not_mixed() -> None:
    parts = BatchReplyAssembler(decode_part)
    other = encode_parts(False, T0 + S + 1)
    half = len(encode_parts()) - 1
    for one, two in itertools.zip_longest(encode_parts()[:half], other[:-1]):
        assert one is None or not parts.add(one)
        assert two is None or not parts.add(two)
    assert parts.add(encode_parts()[half])
    check(parts)


def test_given_parts_that_do_not_hold_what_was_asked_for_then_the_error_reports_it() -> None:
    parts = BatchReplyAssembler(decode_part)
    for each in encode_parts():
        parts.add(each)
    with pytest.raises(WireError, match="700 poses received for 699 instants"):
        parts.join(PAIRS, AT[:-1])
    with pytest.raises(WireError, match="no poses"):
        parts.join((*PAIRS, (SCAN, BASE)), AT)


def test_given_a_gap_between_parts_then_it_is_reported() -> None:
    wrong = [decode_part(each) for each in encode_parts()]
    wrong[1] = wrong[1]._replace(first=wrong[1].first + 1)
    parts = BatchReplyAssembler(lambda data: wrong[data[0]])
    for number in range(len(wrong)):
        parts.add(bytes([number]))
    with pytest.raises(WireError, match="starts at instant 121, but the previous one ends at 120"):
        parts.join(PAIRS, AT)


def test_given_no_parts_then_there_is_nothing_to_put_together() -> None:
    with pytest.raises(WireError):
        concatenate([])
