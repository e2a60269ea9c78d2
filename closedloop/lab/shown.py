"""The lab's page for what another part of the program simulates: it is told what to draw, and moves nothing there."""

import threading
from collections.abc import Callable
from typing import Any

from closedloop.lab.actions import choose
from closedloop.lab.drawn import Message, pack
from closedloop.lab.history import page
from closedloop.lab.server import FIRST_PORT, RUN, Client, Server, new_token

# How long a page may take to be sent what is left at the end, s.
PATIENCE = 10.0


class Shown:
    """The lab's page, open in any number of browsers; one that opens later is sent the newest message of each kind.

    `title`: the page's title until a message says another.
    `host`, `port`: where it listens; the next free port is taken if this one is in use.
    `run`: returns the message of the run for a page, by the part of the time and the columns that it has chosen.
    Raises OutputError if it cannot listen there.
    """

    def __init__(
        self, title: str, host: str = "127.0.0.1", port: int = FIRST_PORT,
        run: Callable[[Client], Message | None] = lambda client: None,
    ) -> None:  # fmt: skip
        self._run = run
        self._clients: list[Client] = []
        self._last: dict[str, bytes] = {}
        self._lock = threading.Lock()
        token = new_token()
        self._server = Server(
            host, port, token, lambda nonce: page(title, nonce=nonce), self._opened, self._said, self._closed
        )
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self._server.port}/?token={token}"

    def tell(self, kind: str, message: Message) -> None:
        """Send a message to every page, and to those that open later."""
        data = pack({"kind": kind, **message})
        with self._lock:
            self._last[kind] = data
            for client in self._clients:
                client.put(kind, data)

    def tell_run(self) -> None:
        """Send each page the run as it is now."""
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            self._send_run(client)

    @property
    def watched(self) -> bool:
        """Whether a page is open."""
        return bool(self._clients)

    def close(self) -> None:
        """Send what is left, and stop listening."""
        for client in list(self._clients):
            client.wait(PATIENCE)
            client.close()
        self._server.close()

    def _send_run(self, client: Client) -> None:
        message = self._run(client)
        if message is not None:
            client.put(RUN, pack({"kind": RUN, **message}))

    def _opened(self, client: Client) -> None:
        with self._lock:
            for kind, data in self._last.items():
                client.put(kind, data)
            self._clients.append(client)
        self._send_run(client)

    def _said(self, client: Client, said: dict[str, Any]) -> None:
        if said.get("do") == "shown":
            client.drawn()
        elif said.get("do") in ("window", "columns"):
            choose(client, said)
            self._send_run(client)

    def _closed(self, client: Client) -> None:
        with self._lock:
            if client in self._clients:
                self._clients.remove(client)
