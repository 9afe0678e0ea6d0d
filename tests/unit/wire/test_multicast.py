"""The multicast group of any URL; it becomes part of commands that root runs."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modelserver.wire.channels import DEFAULT_URL
from modelserver.wire.provider import GROUP, group_of, make_route_command


@pytest.mark.parametrize(
    ("url", "group"),
    [
        (DEFAULT_URL, GROUP),
        ("udpm://239.1.2.3:7667?ttl=1", "239.1.2.3"),
        ("udpm://224.0.0.9", "224.0.0.9"),
        ("udpm://", GROUP),
        ("udpm://192.168.1.1:7667", GROUP),
        ("udpm://[::1", GROUP),
        ("", GROUP),
    ],
)
def test_given_a_bus_then_its_group_is_known(url: str, group: str) -> None:
    assert group_of(url) == group


@given(st.text() | st.text().map("udpm://{}:7667".format))
def test_given_any_text_then_the_route_is_of_a_multicast_group(url: str) -> None:
    command = make_route_command(group_of(url), "lo")
    assert re.fullmatch(r"ip route replace 2[23][0-9](\.[0-9]{1,3}){3}/32 dev lo", command, re.ASCII)
