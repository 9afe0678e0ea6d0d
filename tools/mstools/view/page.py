"""The viewer's page: our page with viser's scene in it, on viser's web server, opened only to those who may see it.

`/scene` and the websocket are viser's; the other paths are answered by what `Page.respond` is set to.

viser serves its page and websocket to anyone who reaches the port, and to any web page that a browser has open: a
websocket is not bound to the origin of its page. The guard here checks each request before viser sees it:

- On loopback Host is a name of loopback: a foreign name that resolves to it (DNS rebinding) is rejected.
- Origin, which browsers add to websockets, and Sec-Fetch-Site, which they add to what a page loads, are those of this
  page.
- Beyond loopback, and on a page that edits (each user of a machine reaches its loopback), a token is needed, by
  whatever name the machine is reached: the link has it once, then a cookie that scripts cannot read. It is compared in
  constant time.

viser's tunnel to a public server is disabled, and a port that is in use is an error instead of the next free one.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import ipaddress
import logging
import queue
import re
import secrets
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import partial
from http.cookies import CookieError, SimpleCookie
from io import StringIO
from typing import Any, Final, NamedTuple
from unittest.mock import patch
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from modelserver.errors import ModelServerError

LOOPBACK_NAMES: Final = ("127.0.0.1", "localhost", "[::1]")
COOKIE: Final = "modelserver_view"
TOKEN_BYTES: Final = 24
SCENE: Final = "/scene"
"""Path of viser's page, or of one of them: /scene/DENSITY/NAME, with the pixels of the screen per pixel of the page."""

_PATH: Final[ContextVar[str]] = ContextVar("path", default=SCENE)
"""The path of the websocket within its tasks."""


class Reply(NamedTuple):
    """An answer to the page. `is_packed`: the body is compressed with gzip; `is_fixed`: it can be cached."""

    body: bytes
    media_type: str = "application/json"
    is_packed: bool = False
    is_fixed: bool = False


class ViewError(ModelServerError):
    """The page cannot be served."""


@dataclass(frozen=True, slots=True)
class Guard:
    """Decides who may see the page: without a `token` who asks for `hosts` (name:port), else who has it.

    `cookie` is the name of the cookie; browsers send those of one port to all ports of a machine.
    """

    hosts: frozenset[str] = frozenset()
    token: str = ""
    cookie: str = COOKIE

    def find_problem(self, request: Request) -> str:
        """Return why a request is denied, empty where it is not."""
        host = request.headers.get("Host", "")
        if not self.token and host not in self.hosts:
            return f"this page is served as {', '.join(sorted(self.hosts))}; open that address"
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return "requests of other pages are denied"
        fetched = request.headers.get("Sec-Fetch-Site", "none")
        if fetched not in ("none", "same-origin") and request.headers.get("Sec-Fetch-Mode") != "navigate":
            return "requests of other pages are denied"
        if self.token and not self._has_token(request):
            return "the token is missing or wrong; open the link that modelserver view printed"
        return ""

    def _has_token(self, request: Request) -> bool:
        cookies = SimpleCookie()
        with suppress(CookieError):
            cookies.load(request.headers.get("Cookie", ""))
        cookie = cookies[self.cookie].value if self.cookie in cookies else ""
        # the link's counts too where a cookie is there: it may be of a viewer that was served here before
        given = (cookie, parse_qs(urlsplit(request.path).query).get("token", [""])[0])
        return any(hmac.compare_digest(each.encode(), self.token.encode()) for each in given)

    async def process(
        self,
        inner: Callable[..., Response | None],
        respond: Callable[[str, Mapping[str, str]], Reply | None],
        connection: ServerConnection,
        request: Request,
    ) -> Response | None:
        """Return the response to a request: a denial, viser's, or that of `respond`; None opens the websocket."""
        if problem := self.find_problem(request):
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"{problem}\n")
        url = urlsplit(request.path)
        if request.headers.get("Upgrade") == "websocket":
            return inner(connection, request)
        if f"{url.path}/".startswith(f"{SCENE}/"):
            response = inner(connection, replace(request, path="/"))
        else:
            query = {name: values[-1] for name, values in parse_qs(url.query).items()}
            response = await asyncio.to_thread(_respond, connection, respond, url.path, query)
        if response is not None:
            response.headers["X-Frame-Options"] = "SAMEORIGIN"
            response.headers["Referrer-Policy"] = "no-referrer"
            if self.token:
                attributes = "HttpOnly; SameSite=Strict; Path=/"
                response.headers["Set-Cookie"] = f"{self.cookie}={self.token}; {attributes}"
        return response


def _respond(
    connection: ServerConnection,
    respond: Callable[[str, Mapping[str, str]], Reply | None],
    path: str,
    query: Mapping[str, str],
) -> Response:
    try:
        reply = respond(path, query)
    except (ValueError, ModelServerError) as error:
        return connection.respond(http.HTTPStatus.BAD_REQUEST, f"{error}\n")
    if reply is None:
        return connection.respond(http.HTTPStatus.NOT_FOUND, "not found\n")
    headers = {
        "Content-Type": reply.media_type,
        "Content-Length": str(len(reply.body)),
        "Cache-Control": "max-age=86400" if reply.is_fixed else "no-store",
    }
    if reply.is_packed:
        headers["Content-Encoding"] = "gzip"
    return Response(http.HTTPStatus.OK, "OK", Headers(headers), reply.body)


class Actions(queue.SimpleQueue[Callable[[], object]]):
    """Actions of the page's widgets, whose callbacks run in threads of their own: executed between two pictures."""

    def on_update(self, field: Any, action: Callable[[], object]) -> None:
        """Queue an action where a person changes a field; values that this program sets have no client."""
        field.on_update(lambda event: self.put(action) if event.client_id is not None else None)

    def on_choice(self, field: Any, action: Callable[[Any], object]) -> None:
        """Queue an action with the value that a person gave a field: the field may have another one until it runs."""
        field.on_update(
            lambda event: self.put(partial(action, event.target.value)) if event.client_id is not None else None
        )

    def add_button(self, gui: viser.GuiApi, label: str, action: Callable[[], object]) -> viser.GuiButtonHandle:
        """Add a button that queues an action."""
        button = gui.add_button(label)
        button.on_click(lambda _: self.put(action))
        return button


# --- content of the page

_SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|$~])")


def escape_markdown(text: str) -> str:
    return _SPECIAL.sub(r"\\\1", text.replace("\n", " "))


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *[[escape_markdown(cell) for cell in row] for row in rows]]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


class PageServer(viser.ViserServer):
    """viser's server without its tunnel to a public server. It knows at which path each browser opened the scene."""

    def __init__(self, host: str, port: int):
        self._paths: dict[int, str] = {}
        super().__init__(host=host, port=port, label="ModelServer", verbose=False)

        async def add(client: viser.ClientHandle) -> None:
            self._paths[client.client_id] = _PATH.get()

        async def remove(client: viser.ClientHandle) -> None:
            self._paths.pop(client.client_id, None)

        self.on_client_connect(add)
        self.on_client_disconnect(remove)

    def find_client(self, name: str) -> viser.ClientHandle | None:
        """Return the browser that opened the scene at /scene/DENSITY/NAME; None without one."""
        clients = self.get_clients()
        found = [number for number, path in list(self._paths.items()) if path.rpartition("/")[2] == name]
        return clients.get(found[-1]) if found else None

    def get_density(self, client: viser.ClientHandle) -> float:
        """Return the pixels of a browser's screen per pixel of its page, 1 where it did not state it."""
        parts = self._paths.get(client.client_id, "").split("/")
        with suppress(ValueError, IndexError):
            return min(max(float(parts[2]), 0.25), 8.0)
        return 1.0

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: what a vehicle does is not published."""


@dataclass
class Page:
    """A served page: `server` adds content to its scene, `link` opens it.

    `respond` answers paths with their queries; None for an unknown path, ValueError for a malformed query.
    """

    server: PageServer
    link: str
    respond: Callable[[str, Mapping[str, str]], Reply | None] = lambda path, query: None

    def close(self) -> None:
        with redirect_stdout(StringIO()):
            self.server.stop()


def open_page(address: str = "127.0.0.1", port: int = 8080, *, with_token: bool = False) -> Page:
    """Serve a page at an address and port; port 0 is any free one. Raises ViewError.

    An address other than loopback, or `with_token`, needs the token in the link.
    """
    try:
        is_loopback = ipaddress.ip_address(address).is_loopback
    except ValueError:
        raise ViewError(f"{address!r} is no IP address; give one of this machine, e.g. 0.0.0.0 for all") from None
    bound = _bind(address, port)
    port = bound.getsockname()[1]
    token = "" if is_loopback and not with_token else secrets.token_urlsafe(TOKEN_BYTES)
    host = f"[{address}]" if ":" in address else address
    reached = _find_own_address() if ipaddress.ip_address(address).is_unspecified else host
    guard = Guard(frozenset(f"{name}:{port}" for name in (*LOOPBACK_NAMES, host)), token, f"{COOKIE}_{port}")
    pages: list[Page] = []

    def respond(path: str, query: Mapping[str, str]) -> Reply | None:
        return pages[0].respond(path, query) if pages else None

    # browsers open connections ahead of need and close them unused: websockets reports each with a traceback
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    # its own messages on stdout are replaced by the link
    serve = partial(_serve, guard, bound, respond)
    with redirect_stdout(StringIO()), patch.object(websockets.asyncio.server, "serve", serve):
        server = PageServer(address, port)
    pages.append(Page(server, f"http://{reached}:{port}/" + (f"?token={token}" if token else "")))
    return pages[0]


def _bind(address: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((address, port))
    except (OSError, OverflowError) as error:
        bound.close()
        reason = getattr(error, "strerror", "") or str(error)
        raise ViewError(f"cannot serve at {address} port {port}: {reason}; choose another with --port N") from None
    return bound


def _find_own_address() -> str:
    """Return an address by which other machines reach this one; sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return "127.0.0.1"
        return str(probe.getsockname()[0])


_SERVE: Final = websockets.asyncio.server.serve


def _serve(guard: Guard, bound: socket.socket, respond: Any, handler: Any, host: str, port: int, **options: Any) -> Any:
    """Serve as viser asks for, with the guard before its own handler, on a socket that is bound already."""
    inner = options.pop("process_request")

    async def handle(connection: ServerConnection) -> None:
        assert connection.request is not None
        _PATH.set(urlsplit(connection.request.path).path)
        await handler(connection)

    return _SERVE(handle, sock=bound, process_request=partial(guard.process, inner, respond), **options)
