"""The server of the lab's page: viser's, on a free port, for its own page alone, without its tunnel elsewhere.

Whoever reaches the port could move the controls and save files, other users of this computer too: they are let in with
the token alone, a random word in the page's address, ``http://127.0.0.1:8080/?token=0123...``. The page is sent on to
``/0123...``, as it opens its websocket below its own address, and a cookie would go to servers on other ports as well.
"""

from __future__ import annotations

import contextlib
import errno
import io
import ipaddress
import secrets
import socket
from collections.abc import Iterator, Mapping
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

from closedloop.base.errors import OutputError

FIRST_PORT, PORTS = 8080, 100  # how many are tried, one after the other


def new_token() -> str:
    """Return a word that nobody can guess."""
    return secrets.token_hex(24)


def serve(host: str, port: int, token: str) -> Any:
    """Return viser's server, without the lines that it prints, and without its tunnel to a server elsewhere.

    It answers those who name the token, and no other.

    Raises
    ------
    OutputError
    """
    import viser

    port = _free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()), _for_its_own_page(is_loopback(host), token):
        server: Any = viser.ViserServer(host=host, port=port, verbose=False)
    # Any client may ask for the tunnel: what it calls is replaced.
    server.request_share_url = lambda verbose=True: None
    return server


def is_loopback(host: str) -> bool:
    """Whether an address, or a name, is that of this computer for itself."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def foreign(headers: Mapping[str, str], loopback: bool) -> bool:
    """Whether a request comes from a page that is not the lab's own.

    A browser names the page in "Origin", and lets any page open a socket to this computer. On loopback "Host" must be a
    name of this computer, too: a name elsewhere may be made to lead here.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if loopback and not is_loopback(urlsplit(f"//{host}").hostname or ""):
        return True
    return origin is not None and urlsplit(origin).netloc != host


def without_token(path: str, token: str) -> str | None:
    """Return what a request asks for below the token, "" if it names the token as a query; None if it names neither."""
    asked = urlsplit(path)
    first, _, rest = asked.path.lstrip("/").partition("/")
    if secrets.compare_digest(first.encode(), token.encode()):
        return f"/{rest}"
    given = parse_qs(asked.query).get("token", [""])[0]
    return "" if secrets.compare_digest(given.encode(), token.encode()) else None


@contextlib.contextmanager
def _for_its_own_page(loopback: bool, token: str) -> Iterator[None]:
    """Let the servers of websockets that start meanwhile refuse what is `foreign`, or comes without the token.

    viser has no setting for that.
    """
    from websockets.asyncio import server as sockets
    from websockets.http11 import Request

    module: Any = sockets
    plain = module.serve

    def serving(handler: Any, *arguments: Any, process_request: Any = None, **settings: Any) -> Any:
        def answer(connection: Any, request: Request) -> Any:
            if foreign(request.headers, loopback):
                return connection.respond(HTTPStatus.FORBIDDEN, "only the lab's own page may use this server\n")
            path = without_token(request.path, token)
            if path is None:
                line = "the lab's address has a token, as it was printed: http://HOST:PORT/?token=...\n"
                return connection.respond(HTTPStatus.FORBIDDEN, line)
            if not path and request.headers.get("Upgrade") is None:
                found = connection.respond(HTTPStatus.FOUND, "")
                found.headers["Location"] = f"/{token}"
            else:
                request.path = path or "/"
                found = process_request(connection, request) if process_request else None
            if found is not None:
                found.headers["Referrer-Policy"] = "no-referrer"
                found.headers["Cache-Control"] = "no-store"
            return found

        return plain(handler, *arguments, process_request=answer, **settings)

    module.serve = serving
    try:
        yield
    finally:
        module.serve = plain


def _free_port(host: str, port: int) -> int:
    """Return the first port from this one on that can be listened on: viser waits for ever where none can.

    Raises
    ------
    OutputError
    """
    fault: Exception | None = None
    for tried in range(port, port + PORTS):
        try:
            family = socket.getaddrinfo(host, tried, type=socket.SOCK_STREAM)[0][0]
            with socket.socket(family) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, tried))
            return tried
        except (OSError, OverflowError, UnicodeError) as error:
            fault = error
            if getattr(error, "errno", None) != errno.EADDRINUSE:
                break
    raise OutputError(f"--host {host} --port {port}: cannot listen there: {fault}")
