"""Who may see the viewer's page."""

from __future__ import annotations

import asyncio
import http.client
import json
import socket
from collections.abc import Iterator, Mapping
from urllib.parse import urlsplit

import pytest

pytest.importorskip("viser", reason="the extra view is not installed: pip install -e '.[view]'")

import viser
from viser._messages import ShareUrlRequest
from websockets.asyncio.client import connect
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request
from websockets.typing import Subprotocol

from mstools.view.page import COOKIE, Guard, Page, Reply, ViewError, open_page

GUARD = Guard(frozenset({"127.0.0.1:8080", "localhost:8080"}))


def make_request(path: str = "/", **headers: str) -> Request:
    return Request(path, Headers({"Host": "127.0.0.1:8080"} | headers))


@pytest.fixture
def page() -> Iterator[Page]:
    opened = open_page(port=0)
    yield opened
    opened.close()


def fetch(page: Page, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.link).port or 0, timeout=10.0)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    response.read()
    connection.close()
    return response


@pytest.mark.parametrize(
    ("headers", "is_allowed"),
    [
        ({}, True),
        ({"Host": "localhost:8080"}, True),
        ({"Origin": "http://127.0.0.1:8080"}, True),
        ({"Host": "127.0.0.1:9"}, False),
        ({"Host": "attacker.example:8080"}, False),
        ({"Origin": "http://attacker.example"}, False),
        ({"Origin": "null"}, False),
        ({"Sec-Fetch-Site": "same-origin"}, True),
        # an image in another page
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}, False),
        # a link in another page
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}, True),
        ({"Origin": "http://127.0.0.1:8080.attacker.example"}, False),
    ],
)
def test_given_a_host_or_origin_then_only_its_own_is_allowed(headers: dict[str, str], is_allowed: bool) -> None:
    assert (GUARD.find_problem(make_request(**headers)) == "") is is_allowed


@pytest.mark.parametrize(
    ("path", "cookie", "is_allowed"),
    [
        ("/?token=secret", "", True),
        ("/", f"{COOKIE}=secret", True),
        ("/", "", False),
        ("/?token=", "", False),
        ("/?token=wrong", "", False),
        ("/?token=secret2", "", False),
        ("/", f"{COOKIE}=wrong", False),
        ("/", f"other=1; {COOKIE}=secret", True),
        ("/?token=%ff%00", "", False),
        # a cookie of a viewer that was served here before does not shut out who has the new link
        ("/?token=secret", f"{COOKIE}=old", True),
    ],
)
def test_given_a_token_then_only_those_who_have_it_are_allowed(path: str, cookie: str, is_allowed: bool) -> None:
    guard = Guard(token="secret")
    headers = {"Cookie": cookie} if cookie else {}
    assert (guard.find_problem(make_request(path, **headers)) == "") is is_allowed


def test_given_a_token_then_the_name_of_the_machine_does_not_matter_but_other_pages_are_denied() -> None:
    guard = Guard(token="secret")
    path, host = "/?token=secret", "vehicle.lan:8080"
    assert guard.find_problem(make_request(path, Host=host, Origin=f"http://{host}")) == ""
    assert guard.find_problem(make_request(path, Host=host, Origin="http://attacker.example")) != ""


def test_given_a_browser_on_this_machine_then_it_gets_the_page_and_no_other_page_may_frame_it(page: Page) -> None:
    response = fetch(page, "/scene")
    assert response.status == 200
    assert response.getheader("X-Frame-Options") == "SAMEORIGIN"
    assert fetch(page, Host="attacker.example").status == 403


def test_given_answers_of_the_page_then_they_are_sent_and_errors_have_their_status(page: Page) -> None:
    def respond(path: str, query: Mapping[str, str]) -> Reply | None:
        if path == "/bad":
            raise ValueError("at must be a number")
        return Reply(json.dumps(dict(query)).encode()) if path == "/state" else None

    page.respond = respond
    assert fetch(page, "/state?at=1&at=2").getheader("Cache-Control") == "no-store"
    assert [fetch(page, path).status for path in ("/state", "/bad", "/other", "/../etc/passwd")] == [200, 400, 404, 404]


def test_given_another_web_page_then_its_websocket_is_denied(page: Page) -> None:
    async def open_websocket(origin: str) -> int:
        address = page.link.replace("http", "ws")
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        try:
            async with connect(address, origin=origin, subprotocols=[protocol]):  # type: ignore[arg-type]
                return 101
        except InvalidStatus as error:
            return error.response.status_code

    assert asyncio.run(open_websocket("http://attacker.example")) == 403
    assert asyncio.run(open_websocket(page.link.rstrip("/"))) == 101


def test_given_a_page_beyond_loopback_then_its_link_has_the_token_that_it_needs() -> None:
    page = open_page("0.0.0.0", 0)
    try:
        query = urlsplit(page.link).query
        host = urlsplit(page.link).netloc
        assert fetch(page, Host=host).status == 403
        response = fetch(page, f"/scene?{query}", Host=host)
        assert response.status == 200
        cookie = response.getheader("Set-Cookie") or ""
        assert "HttpOnly" in cookie
        # browsers send a cookie to all ports of a machine
        assert cookie.startswith(f"{COOKIE}_{urlsplit(page.link).port}=")
        assert fetch(page, "/scene", Host=host, Cookie=cookie.partition(";")[0]).status == 200
    finally:
        page.close()


def test_given_a_port_in_use_then_the_error_names_it_and_the_option() -> None:
    with socket.socket() as used:
        used.bind(("127.0.0.1", 0))
        used.listen()
        port = used.getsockname()[1]
        with pytest.raises(ViewError, match=f"port {port}.*--port"):
            open_page(port=port)


def test_given_no_address_then_the_error_shows_one() -> None:
    with pytest.raises(ViewError, match=r"no IP address.*0\.0\.0\.0"):
        open_page("vehicle.local", 0)


def test_given_a_client_that_asks_for_a_public_tunnel_then_there_is_none(page: Page) -> None:
    assert page.server.request_share_url() is None
    handlers = page.server._websock_server._incoming_handlers[ShareUrlRequest]
    for handler in handlers:
        handler(0, ShareUrlRequest())
    page.server._thread_executor.shutdown(wait=True)
    assert page.server._share_tunnel is None


def test_given_a_connection_that_is_closed_unused_then_nothing_is_printed(
    page: Page, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_connection(("127.0.0.1", urlsplit(page.link).port or 0), timeout=10.0):
        pass
    assert fetch(page, "/scene").status == 200
    found = capsys.readouterr()
    assert (found.out, found.err) == ("", "")
