"""The web server behind a page: viser's, on an address of this machine, for whoever has the printed address.

The address ends in a token. The page's first request trades it for a cookie, without which no connection is opened, so
another user of the machine, or a web page in the same browser, cannot look or move. A connection must also come from
the page itself (Origin) and, where only this machine is listened to, be addressed to it by name (Host). Of what comes
over it, only what the page sends is handed on: viser knows messages that share the page on the internet.
"""

from __future__ import annotations

import asyncio
import functools
import io
import logging
import secrets
import socket
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

from d2_plugin.errors import D2Error
from d2_plugin.extras import imported

log = logging.getLogger(__name__)

LOCAL = ("127.0.0.1", "localhost", "::1")
COOKIE = "d2-view"
LONGEST = 1 << 16
"""Bytes of a message; the page's have a few hundred."""


def serve(host: str, port: int) -> tuple[Any, str]:
    """Start to serve at an address, on the next free port where this one is in use: the server, its URL with the token.

    Raises:
        D2Error: nothing can listen at that address.
    """
    _check_address(host)
    # Of a page that was closed while its image was drawn, and of what a client sent.
    warnings.filterwarnings("ignore", r"Queued a .* on a closed connection|\[viser\] ")
    token = secrets.token_urlsafe(16)
    viser = imported("viser", "viser", "view", "the live viewer")
    # It prints a table with addresses.
    with redirect_stdout(io.StringIO()), _guarded(Access(host, token), viser.infra.Message.deserialize):
        server = viser.ViserServer(host=host, port=port, label="D2-4DGS", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True, control_width="medium")
    name = "localhost" if host in ("127.0.0.1", "0.0.0.0") else f"[{host}]" if ":" in host else host
    return server, f"http://{name}:{server.get_port()}/?token={token}"


class Access(NamedTuple):
    """Which requests are answered."""

    host: str
    """The address that is listened to."""
    token: str

    def problem(self, path: str, headers: Any) -> str:
        """Why a request is refused; nothing where it is answered."""
        asked = headers.get("Host") or ""
        if self.host in LOCAL and urlsplit(f"//{asked}").hostname not in LOCAL:
            return "this page is served to its own machine only"
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != asked:
            return "another page cannot connect to this one"
        try:
            cookie = SimpleCookie("; ".join(headers.get_all("Cookie"))).get(COOKIE)
        except CookieError:
            cookie = None
        known = cookie is not None and secrets.compare_digest(cookie.value.encode(), self.token.encode())
        return "" if known or self.brings_token(path) else "open the whole address that d2 printed, token included"

    def brings_token(self, path: str) -> bool:
        """Whether the address of a request ends in the token."""
        given = parse_qs(urlsplit(path).query).get("token", [""])[0]
        return secrets.compare_digest(given.encode(), self.token.encode())


@contextmanager
def _guarded(access: Access, understood: Callable[[bytes], Any]) -> Iterator[None]:
    """Within it, a server that viser starts asks `access` first: viser has no such place of its own."""
    import websockets.asyncio.server as module
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    plain = module.serve

    def answer(respond: Callable[[Any, Any], Any], connection: Any, request: Any) -> Any:
        try:
            problem = access.problem(request.path, request.headers)
        except (ValueError, LookupError):  # no address, or a header twice
            problem = "the request is malformed"
        if problem:
            return Response(HTTPStatus.FORBIDDEN, "Forbidden", Headers(), problem.encode())
        response = respond(connection, request)
        if response is not None and access.brings_token(request.path):
            cookie = f"{COOKIE}={access.token}; HttpOnly; SameSite=Strict; Path=/"
            response.headers["Set-Cookie"] = cookie
        return response

    class Connection(module.ServerConnection):
        async def recv(self, *arguments: Any, **options: Any) -> Any:
            while True:
                data = await super().recv(*arguments, **options)
                with suppress(Exception):  # what viser cannot read may be anything
                    if _is_the_pages(understood(data)):
                        return data

    def failed(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        log.info("what a page sent was not taken (%s)", context.get("exception", context["message"]))

    def guarded(*arguments: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        asyncio.get_running_loop().set_exception_handler(failed)
        quiet = logging.Logger("websockets", logging.CRITICAL)  # a client that talks nonsense is not worth a traceback
        options |= {"max_size": LONGEST, "create_connection": Connection, "logger": quiet}
        return plain(*arguments, process_request=functools.partial(answer, process_request), **options)

    module.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        module.serve = plain  # type: ignore[misc]


def _is_the_pages(message: Any) -> bool:
    """Whether a message is one that our page sends: the camera, the value of a control, a click at a frustum."""
    kind = type(message).__name__
    if kind == "GuiUpdateMessage":
        return list(message.updates) == ["value"]  # others would replace what belongs to the control
    return kind in ("ViewerCameraMessage", "SceneNodeClickMessage")


def _check_address(host: str) -> None:
    """Raise where nothing can listen at an address: viser would try one port after the other, for ever."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as failure:
        reason = getattr(failure, "strerror", None) or failure
        raise D2Error(
            f"nothing can listen at {host!r} ({reason}): give an address of this machine, or leave --host out"
        ) from None
