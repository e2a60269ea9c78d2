"""The server of the lab's page: viser's, on a free port, for its own page alone, without its tunnel elsewhere."""

from __future__ import annotations

import contextlib
import errno
import io
import ipaddress
import socket
from collections.abc import Iterator, Mapping
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from closedloop.errors import OutputError

FIRST_PORT, PORTS = 8080, 100  # how many are tried, one after the other


def serve(host: str, port: int) -> Any:
    """Return viser's server, without the lines that it prints, and without its tunnel to a server elsewhere.

    Raises
    ------
    OutputError
    """
    import viser

    port = _free_port(host, port)
    with contextlib.redirect_stdout(io.StringIO()), _for_its_own_page(is_loopback(host)):
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


@contextlib.contextmanager
def _for_its_own_page(loopback: bool) -> Iterator[None]:
    """Let the servers of websockets that start meanwhile refuse what is `foreign`: viser has no setting for that."""
    from websockets.asyncio import server as sockets
    from websockets.http11 import Request

    module: Any = sockets
    plain = module.serve

    def serving(handler: Any, *arguments: Any, process_request: Any = None, **settings: Any) -> Any:
        def answer(connection: Any, request: Request) -> Any:
            if foreign(request.headers, loopback):
                return connection.respond(HTTPStatus.FORBIDDEN, "only the lab's own page may use this server\n")
            return process_request(connection, request) if process_request else None

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
