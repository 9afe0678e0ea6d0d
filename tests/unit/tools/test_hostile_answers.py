"""Hostile replies to the commands: names and texts of a false daemon never control the terminal."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lcm
import pytest
from support_lcm import reserved_url

from modelserver.errors import Status
from modelserver.messages import (
    CHANNEL_OF,
    DynamicsAnswer,
    DynamicsReply,
    EdgeReport,
    Explanation,
    ExplanationReply,
    GetDynamics,
    GetExplanation,
    GetMotion,
    GetTransformation,
    Invalid,
    MotionAnswer,
    MotionReply,
    PoseAnswer,
    ReloadModel,
    ReloadReply,
    ReplyHeader,
    TransformReply,
    Unmet,
)
from modelserver.transforms import Pose, Transformation
from modelserver.wire.channels import BY_NAME
from modelserver.wire.codec import decode, encode
from mstools.cli import main

EVIL = "x\n\x1b[2J\x1b]0;owned\x07\r\u202eFORGED"
THREE = (0.0, 0.0, 0.0)
ANSWER = PoseAnswer(Transformation(EVIL, EVIL, Pose(), model_revision=EVIL))
EDGE = EdgeReport("joint", EVIL, True, (EVIL, EVIL), Pose(), "predicted", source=EVIL)
GOOD: dict[type, Any] = {
    GetTransformation: lambda header: TransformReply(header, ANSWER, Unmet.AGE, EVIL),
    GetExplanation: lambda header: ExplanationReply(header, Explanation(ANSWER, (EDGE, EDGE))),
    GetMotion: lambda header: MotionReply(header, MotionAnswer(ANSWER, EVIL, THREE, THREE, THREE, THREE)),
    GetDynamics: lambda header: DynamicsReply(
        header,
        DynamicsAnswer(
            0,
            Invalid(0),
            EVIL,
            math.inf,
            THREE,
            (math.nan,) * 36,
            (EVIL,),
            (math.inf,),
            (0.0,),
            (math.nan,),
            (0.0,),
            (0.0,),
        ),
    ),
    ReloadModel: lambda header: ReloadReply(header, EVIL, (EVIL, EVIL)),
}


@contextmanager
def false_daemon(status: Status) -> Iterator[str]:
    """A stranger that answers before the daemon does, with texts of its own."""
    with reserved_url() as url:
        bus = lcm.LCM(url)
        ended = threading.Event()

        def answering(kind: type) -> Any:
            def answer(_: str, data: bytes) -> None:
                header = decode(BY_NAME[CHANNEL_OF[kind]].type_name, data).header
                reported = ReplyHeader(header.request_id, 1, status, "" if status is Status.OK else EVIL, (EVIL,), EVIL)
                bus.publish(header.reply_channel, encode(GOOD[kind](reported)))

            return answer

        subscriptions = [bus.subscribe(CHANNEL_OF[kind], answering(kind)) for kind in GOOD]

        def run() -> None:
            while not ended.is_set():
                bus.handle_timeout(20)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield url
        finally:
            ended.set()
            thread.join()
            # the handlers refer to the bus, and keep it open
            for each in subscriptions:
                bus.unsubscribe(each)


@pytest.mark.slow
@pytest.mark.parametrize("status", [Status.OK, Status.UNKNOWN_FRAME, Status.FORBIDDEN, Status.REJECTED])
@pytest.mark.parametrize("arguments", [
    ["query", "A:A", "B:B"], ["query", "A:A", "B:B", "--explain"],
    ["query", "A:A", "B:B", "--motion"], ["reload"], ["tree", "--live"],
    ["dynamics", "--equations"], ["dynamics", "--json"],
    ["query", "A:A", "B:B", "--json"],
    ["query", "A:A", "B:B", "--max-age", "1"],
])  # fmt: skip
def test_given_hostile_replies_then_every_line_on_the_terminal_is_plain(
    status: Status, arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MODELSERVER_KEY_FILE", raising=False)
    with false_daemon(status) as url, pytest.raises(SystemExit):
        main([*arguments, "--url", url, "--timeout", "1" if arguments[0] != "tree" else "0.2"])
    out, err = capsys.readouterr()
    assert out + err
    # only line breaks of our own: no text of the false daemon starts a line
    for line in (out + err).splitlines():
        assert line.isprintable(), line
        assert not line.startswith("FORGED")
