"""The server of the lab's page: viser's, on a free port, without its tunnel to a server elsewhere."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
from typing import Any

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
    with contextlib.redirect_stdout(io.StringIO()):
        server: Any = viser.ViserServer(host=host, port=port, verbose=False)
    # Any client may ask for the tunnel: what it calls is replaced.
    server.request_share_url = lambda verbose=True: None
    return server


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
