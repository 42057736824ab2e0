"""Web server of one page with a message channel and a viser scene, all on one port.

| path | content |
| --- | --- |
| `/` | the page |
| `/control` | WebSocket: text messages of the page; status messages as JSON to the page |
| `/view` | viser's own page, which the page embeds |
| `/scene` | WebSocket of viser's page, relayed to viser's server |

One port suffices for a firewall or `ssh -L`, and both pages have the same origin, so that the outer
page receives the keys pressed in the inner one. Browsers let any web site connect to a local server.
Requests from pages of other sites are therefore refused.
"""

import asyncio
import contextlib
import http
import itertools
import json
import logging
import threading
import urllib.request
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from hydrotele.core.errors import InputError

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

_KEEP_CONNECTED = b"<head><script>Document.prototype.hasFocus = () => true</script>"
"""Start of viser's page: viser connects again only if its page has the focus, which an embedded page has not."""
STATUS_RATE = 30.0  # Hz, rate of the status messages to every page
_MIN_MESSAGE_INTERVAL = 0.002  # s between two messages of one page, so that no page occupies the computer
_MAX_MESSAGE_SIZE = 65_536  # bytes
_START_TIMEOUT, _STOP_TIMEOUT = 10.0, 5.0  # s
LOOPBACK_NAMES = ("127.0.0.1", "localhost", "::1")
_PAGE_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self';"
        " frame-src 'self'; img-src data:; frame-ancestors 'none'"
    ),
}
_MALFORMED = 1008  # WebSocket close code: policy violation
_QUIET = logging.getLogger("hydrotele.web_server")  # failed connections of clients are no news
_QUIET.addHandler(logging.NullHandler())
_QUIET.propagate = False


class PageHandlers(NamedTuple):
    """Functions that the server calls, in its own thread.

    Attributes:
        receive: called with the number of a page and its message; returns an answer for the page, or
            an empty text. A ValueError closes the connection of the page.
        status: called with the number of a page; returns its next status message.
        remove: called with the number of a page that has closed.
    """

    receive: Callable[[int, str | bytes], str]
    status: Callable[[int], dict[str, Any]]
    remove: Callable[[int], None]


class WebServer:
    """Web server in a thread.

    Attributes:
        url: address of the page.
        scene_port: port of the viser server on this computer, None until there is one.
    """

    def __init__(self, host: str, port: int, page: str, handlers: PageHandlers) -> None:
        """Start the server.

        Args:
            host: address of the network interface; 127.0.0.1 accepts only this computer.
            port: port, 0 for any free one.
            page: the page as HTML.
            handlers: functions that the server calls.

        Raises:
            InputError: the port is in use, or there is no such interface, or viser is not installed.
        """
        import_viser()
        self._host, self._port, self._page, self._handlers = host, port, page.encode(), handlers
        self.scene_port: int | None = None
        self._scene_page = b""
        self._numbers = itertools.count(1)
        self._loop = asyncio.new_event_loop()
        self._stop: asyncio.Event | None = None
        self._error: OSError | None = None
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._started.wait(_START_TIMEOUT)
        if self._error:
            self._thread.join()
            raise _address_error(host, port, self._error)
        name = f"[{host}]" if ":" in host else host
        self.url = f"http://{name}:{self._port}/"

    def close(self) -> None:
        """Stop the server and close the connections of all pages."""
        if self._stop:
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(_STOP_TIMEOUT)

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        except OSError as error:
            self._error = error
        finally:
            self._started.set()
            self._loop.close()

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve

        self._stop = asyncio.Event()
        async with serve(
            self._handle_connection, self._host, self._port, process_request=self._answer_request,
            select_subprotocol=lambda _, offered: offered[0] if offered else None,
            max_size=_MAX_MESSAGE_SIZE, compression=None, logger=_QUIET, close_timeout=1.0,
        ) as server:  # fmt: skip
            self._port = next(iter(server.sockets)).getsockname()[1]
            self._started.set()
            await self._stop.wait()

    def _answer_request(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Answer a request for a page; return None for a WebSocket."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        is_local = self._host not in LOOPBACK_NAMES or urlsplit(f"//{host}").hostname in LOOPBACK_NAMES
        if not is_local or (origin and urlsplit(origin).netloc != host):
            return connection.respond(http.HTTPStatus.FORBIDDEN, "request of another web site\n")
        path = urlsplit(request.path).path
        if path == "/":
            return _make_page(connection, self._page, _PAGE_HEADERS)
        if path == "/view" and self.scene_port:
            self._scene_page = self._scene_page or _fetch_page(self.scene_port)
            return _make_page(connection, self._scene_page, {})
        if path == "/control" or (path == "/scene" and self.scene_port):
            return None
        return connection.respond(http.HTTPStatus.NOT_FOUND, "there is no such page\n")

    async def _handle_connection(self, connection: "ServerConnection") -> None:
        from websockets.exceptions import ConnectionClosed

        assert connection.request
        with contextlib.suppress(ConnectionClosed, OSError):
            if urlsplit(connection.request.path).path == "/scene":
                await self._relay_scene(connection)
            else:
                await self._exchange_messages(connection)

    async def _exchange_messages(self, connection: "ServerConnection") -> None:
        """Receive the messages of a page, and send it status messages, until it closes."""
        page, answers = next(self._numbers), [""]
        sender = asyncio.create_task(self._send_status(connection, page, answers))
        try:
            async for message in connection:
                answers[0] = self._handlers.receive(page, message)
                await asyncio.sleep(_MIN_MESSAGE_INTERVAL)
        except ValueError:
            self._handlers.remove(page)
            await connection.close(_MALFORMED, "malformed message")
        finally:
            self._handlers.remove(page)
            sender.cancel()

    async def _send_status(self, connection: "ServerConnection", page: int, answers: list[str]) -> None:
        """Send status messages to a page, fewer to one that receives slowly."""
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while True:
                await connection.send(json.dumps({**self._handlers.status(page), "answer": answers[0]}))
                await asyncio.sleep(1.0 / STATUS_RATE)

    async def _relay_scene(self, connection: "ServerConnection") -> None:
        """Connect a viser page with the viser server on this computer."""
        from websockets.asyncio.client import connect
        from websockets.typing import Subprotocol

        protocols = [Subprotocol(connection.subprotocol)] if connection.subprotocol else None
        async with connect(
            f"ws://127.0.0.1:{self.scene_port}", subprotocols=protocols, compression=None, max_size=None, proxy=None
        ) as scene:

            async def copy(source, target) -> None:
                async for message in source:
                    await target.send(message)

            directions = [asyncio.create_task(copy(*ends)) for ends in ((connection, scene), (scene, connection))]
            try:
                await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for direction in directions:
                    direction.cancel()
                await asyncio.gather(*directions, return_exceptions=True)


def import_viser() -> Any:
    """Import viser.

    Raises:
        InputError: viser is not installed.
    """
    try:
        import viser  # pyright: ignore[reportMissingImports] - an extra
    except ImportError:
        raise InputError("--web", "needs viser: pip install 'hydrotele[web]' or pip install viser") from None
    return viser


def _address_error(host: str, port: int, error: OSError) -> InputError:
    import errno
    import socket

    if error.errno == errno.EADDRINUSE:
        return InputError(f"--port {port}", "is in use; choose another, or 0 for any free port")
    if error.errno == errno.EACCES:
        return InputError(f"--port {port}", "is not permitted for this user; choose one above 1023")
    if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
        return InputError(f"--host {host}", "is no address of this computer; valid: 127.0.0.1, 0.0.0.0 (all), ...")
    return InputError(f"--host {host} --port {port}", f"cannot be used: {error.strerror or error}")


def _fetch_page(port: int) -> bytes:
    """Return viser's own page from the viser server on a port of this computer."""
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(f"http://127.0.0.1:{port}/") as answer:
        return answer.read().replace(b"<head>", _KEEP_CONNECTED, 1)


def _make_page(connection: "ServerConnection", body: bytes, headers: dict[str, str]) -> "Response":
    """Return an HTTP response with an HTML page."""
    response = connection.respond(http.HTTPStatus.OK, "")
    del response.headers["Content-Type"], response.headers["Content-Length"]
    content = {
        "Content-Type": "text/html; charset=utf-8",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
    }
    for name, value in {**content, "X-Content-Type-Options": "nosniff", **headers}.items():
        response.headers[name] = value
    response.body = body
    return response
