"""The studio's HTTP and WebSocket server: viser's, behind the rule of `access`, with a script and channel of our own.

viser has no access control, and its key events only trigger. So its server's sockets are opened here: a request
without the token, or of another user, is refused before viser sees it, and the path ``control`` of the same port
carries held keys, gamepads and commands (`control`). viser may also open a public tunnel when a client asks for it;
that is switched off.
"""

from __future__ import annotations

import asyncio
import http
import io
import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from functools import lru_cache
from importlib.resources import files
from types import SimpleNamespace
from typing import Any

import viser
import viser._messages as viser_messages
import viser.infra._infra as viser_infra
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from roboxim_core.errors import ConfigError, ErrorCode, RoboximError
from roboxim_ros.peer_user import user_of_peer
from roboxim_studio.serving.access import Access

NARROW = 0.75
"""Width of a page over its height below which its panel covers the lower part."""
CONTROL = "control"
"""Path of the control channel behind the token."""
SCRIPT = "studio.js"
POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src data:; worker-src blob: data:; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'; connect-src 'self' data: blob: ws://{host} wss://{host}"
)
"""Content security policy of the page: the page sends requests only to this server."""
WARM_UP = b"""
if (self.Worker && self.OffscreenCanvas) {
  const source = "const gl = new OffscreenCanvas(1, 1).getContext('webgl2'); if (gl) gl.finish(); close()";
  new Worker(URL.createObjectURL(new Blob([source])));
}
"""
"""Starts the browser's WebGL in another thread while the page's script is unpacked: where WebGL is software, the first
context of a browser took a quarter of the time to the first picture."""
MAX_BYTES = 16_384
"""Largest message of the control channel."""

Received = Callable[[int, Mapping[str, Any]], None]
"""Called with a page's number and a message of the control channel; with an empty message when the page has gone."""

_opening = threading.Lock()


class Site:
    """A running server. `viser` is what panels and scenes are built with; `send` sends to the pages' own script."""

    def __init__(self, access: Access, port: int = 0, *, received: Received = lambda page, message: None) -> None:
        """Start the server.

        Args:
            access: Who may reach it.
            port: Port to listen at; 0: any.
            received: See `Received`; called in the server's thread, so it must return at once.

        Raises:
            RoboximError: When the port is taken, or the server does not refuse a request without the token.
        """
        self._access = access
        self.received = received
        """See `Received`."""
        self._pages: dict[int, websockets.asyncio.server.ServerConnection] = {}
        self._latest: dict[str, Any] = {}
        self._number = 0
        self._failed: OSError | None = None
        with self._own_sockets(), redirect_stdout(io.StringIO()):  # viser prints an address that lacks the token
            self.viser = viser.ViserServer(host=access.host, port=port, verbose=False, label="RoboXim studio")
        self.port = int(self.viser.get_port())
        handlers = self.viser._websock_server._incoming_handlers
        for message in (viser_messages.ShareUrlRequest, viser_messages.ShareUrlDisconnect):
            handlers.pop(message, None)
        self.viser.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.viser.gui.main_panel.dock_right()
        self._first_view()
        if port and self.port != port:
            self.close()
            raise ConfigError(f"port {port} is taken; choose another with --port, or 0 for any free one")
        self._require_guarded()

    @property
    def url(self) -> str:
        """Address of the page, with the token."""
        return self._access.url(self.port)

    @property
    def pages(self) -> int:
        """Number of open pages."""
        return len(self._pages)

    def send(self, **values: Any) -> None:
        """Send values to every page's script; a page that opens later receives the newest of each name."""
        self._latest |= values
        text = json.dumps(values)
        for connection in tuple(self._pages.values()):
            self._soon(connection.send(text))

    def cut(self) -> None:
        """Close every connection; pages connect again by themselves. For tests of an interrupted network."""
        self.viser._websock_server.disconnect_all_clients()
        for connection in tuple(self._pages.values()):
            self._soon(connection.close())

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(io.StringIO()):
            self.viser.stop()

    def _first_view(self) -> None:
        """Set what a page looks at from its first picture on."""
        self.viser.scene.set_up_direction("+z")
        self.viser.scene.configure_default_lights(False)  # else a page that opens before a scene draws with them first
        self.viser.scene.configure_environment_map(None, environment_intensity=0.0)
        self.viser.initial_camera.position = (1.55, -0.9, 0.95)
        self.viser.initial_camera.look_at = (0.45, 0.0, 0.1)
        self.viser.on_client_connect(_look_above_the_panel)

    def _soon(self, coroutine: Any) -> None:
        loop = self.viser._websock_server._background_event_loop
        if loop is None or loop.is_closed():
            coroutine.close()
            return

        async def quietly() -> None:
            with suppress(ConnectionClosed):
                await coroutine

        asyncio.run_coroutine_threadsafe(quietly(), loop)

    @contextmanager
    def _own_sockets(self) -> Iterator[None]:
        """Let viser's server open its sockets by `_serve` while it starts."""
        with _opening:
            infra: Any = viser_infra
            genuine = infra.websockets
            infra.websockets = SimpleNamespace(
                asyncio=SimpleNamespace(
                    server=SimpleNamespace(
                        serve=self._serve, ServerConnection=websockets.asyncio.server.ServerConnection
                    )
                ),
                exceptions=genuine.exceptions,
                datastructures=genuine.datastructures,
            )
            try:
                yield
            finally:
                infra.websockets = genuine

    def _serve(self, handler: Any, *where: Any, process_request: Any, **options: Any) -> Any:
        """Open the sockets as viser asks, with the guard in front of its handlers."""

        def checked(connection: Any, request: Request) -> Response | None:
            rest = self._access.path(request.path, request.headers)
            if rest is None or not (self._access.open_network or _of_own_user(connection)):
                return _answer(http.HTTPStatus.FORBIDDEN, b"open the address that 'roboxim studio' printed\n")
            if request.headers.get("Upgrade", "").lower() == "websocket":
                return None
            if rest == SCRIPT:
                return _answer(http.HTTPStatus.OK, _script(), "application/javascript; charset=utf-8")
            if rest not in ("", "index.html"):
                return _answer(http.HTTPStatus.NOT_FOUND, b"not found\n")
            # unzipped: the page needs our script's tag
            plain = Request("/", Headers({"Host": request.headers.get("Host", "")}))
            page: Response = process_request(connection, plain)
            host = request.headers.get("Host", "")
            return _answer(page.status_code, _with_script(bytes(page.body or b"")), "text/html; charset=utf-8", host)

        async def handle(connection: Any) -> None:
            rest = self._access.path(connection.request.path, connection.request.headers)
            if rest == CONTROL:
                await self._control(connection)
            else:
                await handler(connection)

        return websockets.asyncio.server.serve(handle, *where, process_request=checked, **options)

    async def _control(self, connection: Any) -> None:
        self._number += 1
        page = self._number
        self._pages[page] = connection
        try:
            await connection.send(json.dumps(self._latest))
            async for text in connection:
                if isinstance(text, str) and len(text) <= MAX_BYTES and (message := _object(text)):
                    self.received(page, message)
        except ConnectionClosed:
            pass
        finally:
            self._pages.pop(page, None)
            self.received(page, {})

    def _require_guarded(self) -> None:
        """Ask for the page without the token; refuse to run if it comes."""
        from http.client import HTTPConnection

        connection = HTTPConnection("127.0.0.1", self.port, timeout=10)
        try:
            connection.request("GET", "/")
            status = connection.getresponse().status
        finally:
            connection.close()
        if status != http.HTTPStatus.FORBIDDEN:
            self.close()
            raise RoboximError(
                f"the studio's server answered {status} to a request without the token, expected 403: the installed "
                f"viser {viser.__version__} opens its sockets in another way; install the locked version",
                ErrorCode.INTERNAL,
            )


def _look_above_the_panel(client: Any) -> None:
    """Move a narrow page's view up, where its panel does not cover it."""
    if client.camera.image_width < NARROW * client.camera.image_height:
        client.camera.position, client.camera.look_at = (2.1, -1.35, 1.5), (0.4, 0.05, -0.95)


def _of_own_user(connection: Any) -> bool:
    """Return whether this user, or the superuser, has the other end; true if the kernel does not report users.

    Other users can read the address in the command line of the browser that was started with it.
    """
    try:
        return user_of_peer(connection.transport.get_extra_info("socket")) in (os.geteuid(), 0)
    except (OSError, AttributeError):  # AttributeError: no netlink, not Linux
        return True


def _object(text: str) -> dict[str, Any]:
    """Return a message of the control channel; empty when it is none."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _answer(
    status: int | http.HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8", host: str = ""
) -> Response:
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
    )
    if host:
        headers["Content-Security-Policy"] = POLICY.format(host=host)
    return Response(int(status), http.HTTPStatus(status).phrase, headers, body)


@lru_cache(maxsize=1)
def _script() -> bytes:
    return (files("roboxim_studio.serving") / SCRIPT).read_bytes()


@lru_cache(maxsize=2)
def _with_script(page: bytes) -> bytes:
    """Return viser's page with the studio's script and title, and what starts WebGL before the page's own script."""
    page = page.replace(b"<head>", b"<head><script>" + WARM_UP + b"</script>", 1)
    return page.replace(b"</head>", b'<script src="studio.js" defer></script></head>', 1).replace(
        b"<title>Viser</title>", b"<title>RoboXim studio</title>", 1
    )
