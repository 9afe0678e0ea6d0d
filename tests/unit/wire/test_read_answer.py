"""The fast path of a client for replies, compared with the codec."""

from __future__ import annotations

import contextlib
import struct
from collections import OrderedDict

import pytest

from modelserver.client.remote import decode_pose_reply
from modelserver.errors import Status, WireError
from modelserver.messages import Invalid, Origin, PoseAnswer, Quality, ReplyHeader, TransformReply, Unmet
from modelserver.transforms import Pose, Transformation
from modelserver.wire.codec import decode, encode, read_answer

KIND = "get_transformation_reply_t"
INTEREST, REFERENCE = "Camera:Lens", "Base:Ö"
POSE = Pose.from_rpy((1.0, -2.0, 0.5), 0.3, -0.4, 2.0)


def covariance():
    return tuple([float(number) for number in range(36)])


def answers():
    transformation = Transformation(INTEREST, REFERENCE, POSE, covariance, model_revision="abc")
    stamped = Transformation(INTEREST, REFERENCE, POSE, None, 1_700_000_000_000_000, int(Invalid.TILTED), 3, 7, "abc")
    return (
        PoseAnswer(transformation),
        PoseAnswer(transformation, quality=Quality.LOOP),
        PoseAnswer(stamped, Origin(5e5, 4e6, 80.0, 32, True, 7), Quality.PREDICTED, 1.0, 0.1, 12.0),
    )


def reply(answer, revision="abc"):
    return encode(TransformReply(ReplyHeader(5, 1_700_000_000_000_000, model_revision=revision), answer))


@pytest.mark.parametrize("number", range(3))
def test_given_the_reply_to_a_question_then_it_reads_what_the_codec_reads(number):
    data = reply(answers()[number])
    found = read_answer(data, INTEREST, REFERENCE)
    whole = decode(KIND, data).answer
    assert repr(found) == repr(whole)
    assert found.transformation == whole.transformation


def test_given_one_that_holds_for_good_then_it_is_read_once_whatever_its_id_and_stamp():
    first = read_answer(reply(answers()[0], "once"), INTEREST, REFERENCE)
    data = encode(TransformReply(ReplyHeader(9, 8, model_revision="once"), answers()[0]))
    assert read_answer(data, INTEREST, REFERENCE) is first
    other = reply(answers()[2], "once")
    assert read_answer(other, INTEREST, REFERENCE) is not read_answer(other, INTEREST, REFERENCE)


def test_given_a_full_cache_then_the_oldest_answer_is_evicted_and_read_again(monkeypatch):
    monkeypatch.setattr("modelserver.wire.codec._MAX_CACHED_ANSWERS", 2)
    monkeypatch.setattr("modelserver.wire.codec._ANSWER_CACHE", OrderedDict())
    cached = [reply(answers()[0], f"bounded {number}") for number in range(3)]
    first, second, _ = (read_answer(data, INTEREST, REFERENCE) for data in cached)
    assert read_answer(cached[1], INTEREST, REFERENCE) is second
    again = read_answer(cached[0], INTEREST, REFERENCE)
    assert again is not first
    assert again.transformation == first.transformation


def test_given_other_frames_or_an_error_then_the_whole_reply_is_to_be_read():
    data = reply(answers()[0], "others")
    assert read_answer(data, REFERENCE, INTEREST) is None
    assert read_answer(data, INTEREST, "Base:O") is None
    header = ReplyHeader(5, 6, Status.UNKNOWN_FRAME, "no such frame", ("Base:O",), "abc")
    assert read_answer(encode(TransformReply(header)), INTEREST, REFERENCE) is None
    unmet = TransformReply(ReplyHeader(5, 6, model_revision="abc"), answers()[0], Unmet.AGE, "old")
    assert read_answer(encode(unmet), INTEREST, REFERENCE) is None
    assert decode_pose_reply(encode(unmet), INTEREST, REFERENCE)[-2:] == (Unmet.AGE, "old")
    assert read_answer(b"", INTEREST, REFERENCE) is None
    assert read_answer(b"\1" + data[1:], INTEREST, REFERENCE) is None


def test_given_bytes_that_are_cut_or_damaged_then_no_answer_comes_of_them():
    data = reply(answers()[0], "damaged")
    for end in range(len(data)):
        # the client then reads the whole reply, which reports what is wrong
        with contextlib.suppress(struct.error, WireError):
            assert read_answer(data[:end], INTEREST, REFERENCE) is None
        with pytest.raises(WireError):
            decode(KIND, data[:end])
    assert read_answer(data + b"\0", INTEREST, REFERENCE) is None
    with pytest.raises(WireError, match="too many"):
        decode(KIND, data + b"\0")
    names = data.index(REFERENCE.encode()) + len(REFERENCE.encode()) + 1
    with pytest.raises(WireError, match="rigid"):
        read_answer(data[:names] + b"\0" * 8 + data[names + 8 :], INTEREST, REFERENCE)
