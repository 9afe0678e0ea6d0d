"""Parts of a reply: lost, twice, out of order, and of two answers to one question."""

from __future__ import annotations

import itertools
import random
from functools import cache

import numpy as np
import pytest
from support_moving import BASE, DEEP, SCAN, T0, UTM, S, view

from modelserver.client.parts import Parts, stacked
from modelserver.core.answers import COVARIANCES_IN_PART, POSES_IN_PART, DeferredAnswer
from modelserver.errors import WireError
from modelserver.messages import GetTransformations, ManyReply, RequestHeader
from modelserver.platform.many import many
from modelserver.platform.steps import complete
from modelserver.wire.codec import decode, encode

PAIRS = ((SCAN, UTM), (DEEP, BASE))
AT = T0 + np.arange(700, dtype=np.int64) * 1000


@cache
def sent(covariance: bool = True, utime: int = T0 + S) -> tuple[bytes, ...]:
    request = GetTransformations(RequestHeader(5, "REPLY_ME"), PAIRS, tuple(AT.tolist()), with_covariance=covariance)
    return tuple(encode(part) for part in complete(DeferredAnswer(view(1.0), request, utime).work()))


def opened(data: bytes) -> ManyReply:
    found = decode("get_transformations_reply_t", data)
    assert isinstance(found, ManyReply)
    return found


def check(parts: Parts) -> None:
    for (interest, reference), found in zip(PAIRS, parts.joined(PAIRS, AT), strict=True):
        expected = many(view(1.0), interest, reference, AT)
        assert (found.frame_of_interest, found.frame_of_reference) == (interest, reference)
        assert np.array_equal(found.vectors, expected.vectors)
        assert found.covariances is not None
        assert np.array_equal(found.covariances, expected.covariances)
        for field in ("utimes", "status", "invalid", "quality", "epochs"):
            assert np.array_equal(getattr(found, field), getattr(expected, field)), field
        assert found.origin == expected.origin


def test_given_covariances_then_parts_fit_a_datagram() -> None:
    assert len(sent()) == 2 * -(-len(AT) // COVARIANCES_IN_PART)
    assert len(sent(False)) == 2 * -(-len(AT) // POSES_IN_PART)
    assert max(map(len, (*sent(), *sent(False)))) < 64_000


@pytest.mark.parametrize("seed", range(5))
def test_given_parts_in_any_order_and_twice_then_the_whole_is_the_same(seed: int) -> None:
    rng = random.Random(seed)
    order = list(sent()) + rng.choices(sent(), k=6)
    rng.shuffle(order)
    parts = Parts(opened)
    done = [parts.add(each) for each in order]
    # whole when the last that was missing has come, and not before
    first = done.index(True)
    assert len({*order[: first + 1]}) == len(sent())
    assert len({*order[:first]}) < len(sent())
    check(parts)


def test_given_a_part_that_is_lost_then_it_is_not_whole_until_the_question_is_asked_again() -> None:
    parts = Parts(opened)
    assert [parts.add(each) for each in sent()[1:]] == [False] * (len(sent()) - 1)
    again = sent(utime=T0 + S + 1)
    assert [parts.add(each) for each in again] == [False] * (len(again) - 1) + [True]
    check(parts)


def test_given_two_answers_to_one_question_then_their_parts_are_not_mixed() -> None:
    parts = Parts(opened)
    other = sent(False, T0 + S + 1)
    half = len(sent()) - 1
    for one, two in itertools.zip_longest(sent()[:half], other[:-1]):
        assert one is None or not parts.add(one)
        assert two is None or not parts.add(two)
    assert parts.add(sent()[half])
    check(parts)


def test_given_parts_that_do_not_hold_what_was_asked_for_then_the_error_says_so() -> None:
    parts = Parts(opened)
    for each in sent():
        parts.add(each)
    with pytest.raises(WireError, match="700 poses came for 699 instants"):
        parts.joined(PAIRS, AT[:-1])
    with pytest.raises(WireError, match="no poses"):
        parts.joined((*PAIRS, (SCAN, BASE)), AT)


def test_given_a_gap_between_parts_then_it_is_told() -> None:
    wrong = [opened(each) for each in sent()]
    wrong[1] = wrong[1]._replace(first=wrong[1].first + 1)
    parts = Parts(lambda data: wrong[data[0]])
    for number in range(len(wrong)):
        parts.add(bytes([number]))
    with pytest.raises(WireError, match="begins at instant 121, the one before ends at 120"):
        parts.joined(PAIRS, AT)


def test_given_no_parts_then_there_is_nothing_to_put_together() -> None:
    with pytest.raises(WireError):
        stacked([])
