"""`modelserver reload`: what came of it, in words; the daemon itself is in the scenario tests."""

from __future__ import annotations

import pytest
from support_lcm import reserved_url

from modelserver.client.remote import Platform
from modelserver.errors import NoServerError
from modelserver.messages import ReloadReply, ReplyHeader
from modelserver.transforms import Pose, Transformation
from mstools.cli import main
from mstools.commands.control import describe_reload

SAME = ReloadReply(ReplyHeader(1, 2, model_revision="aaaa"), "aaaa")
OTHER = ReloadReply(ReplyHeader(1, 2, model_revision="aaaa"), "bbbb", ("body Lamp is gone", "evil\x1b[2J"))


@pytest.mark.parametrize(
    ("reply", "dry_run", "words"),
    [
        (SAME, False, ["nothing changed: revision aaaa"]),
        (SAME, True, ["nothing would change: revision aaaa"]),
        (OTHER, True, ["the geometry in force would be revision bbbb; changes:", "  body Lamp is gone"]),
        (OTHER, False, ["the geometry in force is now revision bbbb; changes:", "  body Lamp is gone"]),
    ],
)
def test_given_a_reply_then_people_see_what_changes(reply: ReloadReply, dry_run: bool, words: list[str]) -> None:
    text = describe_reload(reply, dry_run)
    assert text.splitlines()[: len(words)] == words
    assert all(line.isprintable() for line in text.splitlines())


def test_given_nobody_then_the_request_goes_out_once_and_one_line_reports_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with reserved_url() as url:
        with pytest.raises(SystemExit) as ended:
            main(["reload", "--url", url, "--timeout", "0.05"])
        assert ended.value.code == 1
        assert "PLATFORM_GET_BODY_LIST" in capsys.readouterr().err
        # however often a question would be asked: what was done is not to be done again
        with Platform(url, timeout=0.05, retries=1) as platform:
            for act in (
                lambda: platform.set_state_vector(Transformation("A:A", "World:UTM", Pose())),
                lambda: platform.set_h_transform(Transformation("A:A", "World:UTM", Pose())),
            ):
                with pytest.raises(NoServerError, match=r"after 1 try of 0\.1 s"):
                    act()
            # a reload may take a minute: whether there is a server is asked first
            with pytest.raises(NoServerError, match=r"PLATFORM_GET_BODY_LIST.*after 2 tries of 0\.05 s"):
                platform.reload_model()
