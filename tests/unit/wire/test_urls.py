"""Invalid LCM URLs, each with a hint."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.provider import find_url_problem, resolve_url


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("nonsense", "is no URL of LCM's, which has udpm, mpudpm, tcpq, file"),
        ("239.255.76.67:7667", "is no URL of LCM's, which has udpm, mpudpm, tcpq, file"),
        ("nonsense://", "is no URL of LCM's, which has udpm, mpudpm, tcpq, file"),
        ("udp://239.255.76.67:7667", "is no URL of LCM's, which has udpm, mpudpm, tcpq, file"),
        ("UDPM://239.255.76.67:7667", "is no URL of LCM's, which has udpm, mpudpm, tcpq, file"),
        ("memq://", "memq:// does not leave the process"),
        ("file://", "it names no log"),
        ("udpm://nonsense", "is no multicast address: a group between"),
        ("udpm://localhost:7667", "is no multicast address: a group between"),
        ("udpm://ff02::1:7667", "is no multicast address: a group between"),
        ("udpm://:7667", "is no multicast address: a group between"),
        ("udpm://10.0.0.1:7667", "is no multicast address: a group between"),
        (
            "udpm://127.0.0.1:7667?ttl=0",
            "is no multicast address: a group between",
        ),
        ("udpm://240.0.0.1:7667", "is no multicast address: a group between"),
        ("mpudpm://10.0.0.1:7667", "is no multicast address: a group between"),
        ("udpm://239.255.76.67", "is no multicast address: a group between"),
        (
            "udpm://239.255.76.67?ttl=0",
            "is no multicast address: a group between",
        ),
        ("udpm://239.255.76.67:", "is no multicast address: a group between"),
        ("udpm://239.255.76.67:0", "is no multicast address: a group between"),
        ("udpm://239.255.76.67:-5", "is no multicast address: a group between"),
        (
            "udpm://239.255.76.67:99999?ttl=0",
            "is no multicast address: a group between",
        ),
        ("udpm://239.255.76.67:port", "is no multicast address: a group between"),
        (
            "udpm://239.255.76.67:7667?ttl=one",
            "is no multicast address: a group between",
        ),
        (
            "udpm://239.255.76.67:7667?ttl=",
            "is no multicast address: a group between",
        ),
        (
            "udpm://239.255.76.67:7667?ttl",
            "is no multicast address: a group between",
        ),
        (
            "udpm://239.255.76.67:7667?ttl=300",
            "is no multicast address: a group between",
        ),
        (
            "udpm://239.255.76.67:7667?recv_buf_size=1&ttl=-1",
            "is no multicast address: a group between",
        ),
        ("udpm://?ttl=1.5", "is no multicast address: a group between"),
    ],
)
def test_given_an_invalid_url_then_the_problem_names_what_to_write(url: str, words: str) -> None:
    assert words in find_url_problem(url)
    # also with the buffer option
    assert words in find_url_problem(resolve_url(url))


@pytest.mark.parametrize(
    "url",
    [
        DEFAULT_URL,
        "udpm://",
        "udpm://?ttl=1",
        "udpm://239.255.76.67:7667",
        "udpm://224.0.0.1:1?ttl=255&recv_buf_size=5",
        "udpm://239.255.76.67:0x1E13",
        "mpudpm://",
        "mpudpm://239.255.76.67",
        "mpudpm://239.255.76.67:0?ttl=0",
        "tcpq://",
        "tcpq://127.0.0.1:7700",
        "tcpq://nonsense",
        "file:///drive.lcm",
        "file:///drive.lcm?mode=w",
    ],
)
def test_given_a_url_that_liblcm_takes_then_nothing_is_wrong_with_it(url: str) -> None:
    assert find_url_problem(url) == ""


@given(st.one_of(st.text(), st.text().map("udpm://{}".format), st.text().map("udpm://239.255.76.67:{}".format)))
def test_given_any_text_then_an_answer_is_one_line(url: str) -> None:
    text = find_url_problem(url)
    assert text.isprintable() or not text
