"""The server of the lab's page, on a free port, for its own page alone; and work of which only the newest matters.

Whoever reaches the port could move the controls and save files, other users of this computer too: they are let in with
the token alone, a random word in the page's address, ``http://127.0.0.1:8080/?token=0123...``. The page is sent on to
``/0123...``, as it opens its websocket below its own address, and a cookie would go to servers on other ports as well.
"""

import contextlib
import errno
import ipaddress
import json
import logging
import math
import os
import secrets
import socket
import sys
import threading
import time as clock
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from http import HTTPStatus
from importlib.util import find_spec
from typing import Any, Generic, TypeVar
from urllib.parse import parse_qs, urlsplit

from closedloop.base.errors import OutputError


def is_loopback(host: str) -> bool:
    """Whether an address, or a name, is that of this computer for itself."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


Q = TypeVar("Q")
A = TypeVar("A")

logger = logging.getLogger(__name__)

# While requests go on, work that waits for a rest takes no larger part of the time than one over the first; what takes
# longer than the second, s, waits for the rest, however late it comes.
SHARE, LONG = 20.0, 0.3


class Newest(Generic[Q, A]):
    """A thread that computes the newest request.

    `compute`: from a request to its answer; it runs in the thread.
    `show`: takes each answer, in the thread. An answer is shown even if a newer request has come meanwhile, so that
        something moves while requests come faster than they are computed.
    `rest`, `most`: wait until no other request has come for `rest`, s, but no longer than `most` after the first that
        waits, or `SHARE` times what the work took last: work that takes long leaves the time to others, and waits on if
        it takes more than `LONG`.
    `held`: whether something goes on that will bring another request. Then it does not rest.
    """

    def __init__(
        self, compute: Callable[[Q], A], show: Callable[[A], None] = lambda answer: None, rest: float = 0.0,
        most: float = 0.0, held: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        self._compute, self._show, self._rest, self._most, self._held = compute, show, rest, most, held
        self._first = self._last = self._took = 0.0
        self._changed = threading.Condition()
        self._waiting: list[Q] = []
        self._busy, self._closed = False, False
        self.dropped = 0
        self._thread = threading.Thread(target=self._work, name="closedloop-lab", daemon=True)
        self._thread.start()

    def ask(self, request: Q) -> None:
        """Compute this as soon as possible, and not what is still waiting."""
        with self._changed:
            self.dropped += len(self._waiting)
            self._last = clock.monotonic()
            self._first = self._first if self._waiting else self._last
            self._waiting = [request]
            self._changed.notify_all()

    @property
    def idle(self) -> bool:
        """Whether the newest request is answered and shown."""
        return not self._busy and not self._waiting

    @property
    def overtaken(self) -> bool:
        """Whether a newer request waits than the one which is being computed."""
        return bool(self._waiting)

    def wait(self, seconds: float = 60.0) -> bool:
        """Wait until the newest request is answered and shown; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: self.idle, seconds)

    def close(self, seconds: float = 5.0) -> None:
        """End the thread, after the work at hand."""
        with self._changed:
            self._waiting, self._closed = [], True
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(seconds)

    def _left(self) -> float:
        """Return how long the request that waits is still to wait, s."""
        now = clock.monotonic()
        rests = now if self._held() else self._last
        most = max(self._most, SHARE * self._took) if self._took <= LONG else math.inf
        return min(rests + self._rest, self._first + most) - now

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                while not self._closed and (left := self._left()) > 0.0:
                    self._changed.wait(left)
                if self._closed:
                    return
                request, self._busy = self._waiting.pop(), True
            began = clock.monotonic()
            try:
                self._show(self._compute(request))
            except Exception:  # the thread goes on: `compute` turns what can be foreseen into an answer
                logger.exception("a result could not be computed or shown")
            finally:
                with self._changed:
                    self._busy, self._took = False, clock.monotonic() - began
                    self._changed.notify_all()


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    shell = get_ipython()
    return shell is not None and hasattr(shell, "kernel")


def proxied(port: int) -> str:
    """Return the path at which Jupyter's own server passes this port on, "" if it does not.

    Where the notebook runs on another computer, as over SSH, the browser reaches Jupyter's server alone. It passes
    ports on if jupyter-server-proxy is installed: ``/proxy/8080/`` below the server's base address.
    """
    if find_spec("jupyter_server_proxy") is None:
        return ""
    base = os.environ.get("JUPYTERHUB_SERVICE_PREFIX", "")
    if not base:
        from jupyter_server.serverapp import list_running_servers

        servers = {int(server["pid"]): str(server["base_url"]) for server in list_running_servers()}
        base = servers.get(os.getppid(), "")
    return f"{base.rstrip('/')}/proxy/{port}/" if base else ""


FIRST_PORT, LAST_PORT, PORTS = 8080, 65535, 100  # how many are tried, one after the other


# The slot of runs; a page that has not said for so long, s, that it has drawn the last is sent another anyway.
RUN, FORGOTTEN = "run", 5.0
LONGEST, MOST_COLUMNS = 1_000_000, 8  # bytes of what a page says; columns that it may show
PING = 20.0  # s, after so long a page without news is asked whether it is still there
# Pages that may be open; sockets that have not asked for anything yet, and how long, s, they may take to.
PAGES, HALF_OPEN, PATIENCE = 32, 16, 5.0
# A script or a style that is not the server's own does not run in the page, which loads nothing and asks nobody else.
POLICY = (
    "default-src 'none'; script-src 'nonce-{0}'; style-src 'nonce-{0}'; img-src data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'"
)


def finite(value: Any, otherwise: float) -> float:
    """Return a finite number that a page has sent; an integer beyond every float is none."""
    good = isinstance(value, int | float) and abs(value) <= sys.float_info.max
    return float(value) if good else otherwise


class Client:
    """A page that is open: what waits to be sent to it, of each kind the newest only.

    Runs wait until the page says that it has drawn the one before: a page that is slow is sent fewer, and none late.
    """

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._changed = threading.Condition()
        self._waiting: dict[str, bytes] = {}
        self._drawn, self._sent, self._open = True, 0.0, True
        self.window: tuple[float, float] | None = None
        self.columns: tuple[str, ...] = ()
        self.pulls = 0  # forces from outside that there were before the pull that goes on
        self.time = 0.0
        threading.Thread(target=self._send, name="closedloop-page", daemon=True).start()

    def put(self, slot: str, data: bytes) -> None:
        """Send a message as soon as may be, instead of that which waits in this slot."""
        with self._changed:
            self._waiting.pop(slot, None)
            self._waiting[slot] = data
            self._changed.notify_all()

    def choose(self, said: Mapping[str, Any]) -> None:
        """Take the part of the time, or the further columns, that the page is to show."""
        if said["do"] == "columns":
            names = said.get("names")
            self.columns = tuple(map(str, names[:MOST_COLUMNS])) if isinstance(names, list) else ()
            return
        given = said.get("range")
        self.window = None
        if isinstance(given, list) and len(given) == 2:
            begin, end = (finite(each, math.nan) for each in given)
            self.window = (begin, end) if begin < end else None

    def drawn(self) -> None:
        """Take that the page has drawn the run that was sent last."""
        with self._changed:
            self._drawn = True
            self._changed.notify_all()

    def wait(self, seconds: float) -> bool:
        """Wait until nothing waits to be sent; return whether that is so."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._waiting, seconds)

    def close(self) -> None:
        """Send what waits, but no more, and close the socket."""
        with self._changed:
            self._open = False
            self._changed.notify_all()

    def _next(self) -> str | None:
        """Return the slot whose message may be sent now."""
        free = self._drawn or clock.monotonic() - self._sent > FORGOTTEN
        return next((slot for slot in self._waiting if slot != RUN or free), None)

    def _send(self) -> None:
        from websockets.exceptions import ConnectionClosed

        while True:
            with self._changed:
                while (slot := self._next()) is None and self._open:
                    self._changed.wait(FORGOTTEN)
                if slot is None:
                    break
                data = self._waiting.pop(slot)
                if slot == RUN:
                    self._drawn, self._sent = False, clock.monotonic()
            try:
                self._connection.send(data)
            except (ConnectionClosed, OSError):
                return
            with self._changed:
                self._changed.notify_all()
        self._connection.close()


class Server:
    """The lab's server: its page to those who name the token, and a socket below the same address.

    `host`, `port`: where it listens; at the next free port if that one is taken.
    `token`: what lets in.
    `page`: returns the page, given the word (nonce) that its own scripts and styles carry.
    `opened`, `said`, `closed`: called with a `Client` when its page opens, with it and what its page says, {} if that
        is no JSON object, and when it is gone.
    `framed`: whether the page may stand inside another one, as that of a notebook.
    Raises OutputError if it cannot listen there.
    """

    def __init__(
        self, host: str, port: int, token: str, page: Callable[[str], str], opened: Callable[[Client], None],
        said: Callable[[Client, Any], None], closed: Callable[[Client], None] = lambda client: None,
        framed: bool = False,
    ) -> None:  # fmt: skip
        from websockets.sync.server import serve

        self._framed, self._half_open, self._pages = framed, deque[socket.socket](), 0
        self._lock = threading.Lock()
        self.host, self.port = host, _free_port(host, port)
        self._page, self._opened, self._said, self._closed = page, opened, said, closed
        # Jupyter's server passes on the name by which the browser knows it: there the token alone lets in
        gate = partial(self._checked_answer, is_loopback(host) and not framed, token)
        # The server would tell a user of every page that was closed.
        found = logging.getLogger("closedloop.lab.socket")
        found.setLevel(logging.CRITICAL)
        self._server = serve(
            self._talk, host, self.port, process_request=gate, compression=None, max_size=LONGEST, close_timeout=1.0,
            ping_interval=PING, logger=found, server_header=None, open_timeout=PATIENCE,
            create_connection=self._connection,  # type: ignore[arg-type]  # it is called, and nothing more
        )  # fmt: skip
        threading.Thread(target=self._server.serve_forever, name="closedloop-server", daemon=True).start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()

    def _connection(self, sock: socket.socket, *given: Any, **more: Any) -> Any:
        """Return a connection that is half open; where there are too many the oldest of them is closed."""
        from websockets.sync.server import ServerConnection

        with self._lock:
            self._half_open.append(sock)
            oldest = self._half_open.popleft() if len(self._half_open) > HALF_OPEN else None
        if oldest is not None:
            with contextlib.suppress(OSError):  # it was closed already
                oldest.shutdown(socket.SHUT_RDWR)
        return ServerConnection(sock, *given, **more)

    def _checked_answer(self, loopback: bool, token: str, connection: Any, request: Any) -> Any:
        """Return the answer to a request, with what a browser is to know of it; None for one that opens the socket."""
        with self._lock, contextlib.suppress(ValueError):
            self._half_open.remove(connection.socket)
        nonce = secrets.token_urlsafe(16)
        try:
            found = self._answer(loopback, token, nonce, connection, request)
        except (ValueError, LookupError):  # neither an address nor a host can be read of it, or there are two of one
            found = connection.respond(
                HTTPStatus.BAD_REQUEST, "the request has a Host or an address of no known form\n"
            )
        if found is None:
            return None
        policy = POLICY.format(nonce)
        if not self._framed:
            policy += "; frame-ancestors 'none'"
            found.headers["X-Frame-Options"] = "DENY"
        found.headers["Content-Security-Policy"] = policy
        found.headers["X-Content-Type-Options"] = "nosniff"
        found.headers["Referrer-Policy"] = "no-referrer"
        found.headers["Cache-Control"] = "no-store"
        return found

    def _answer(self, loopback: bool, token: str, nonce: str, connection: Any, request: Any) -> Any:
        if foreign(request.headers, loopback):
            return connection.respond(HTTPStatus.FORBIDDEN, "only the lab's own page may use this server\n")
        path = without_token(request.path, token)
        if path is None:
            line = "the lab's address has a token, as it was printed: http://HOST:PORT/?token=...\n"
            return connection.respond(HTTPStatus.FORBIDDEN, line)
        if self._pages >= PAGES:
            line = f"{PAGES} pages of the lab are open, and no more may be: close one\n"
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, line)
        if request.headers.get("Upgrade") is not None:
            return None
        if not path:
            found = connection.respond(HTTPStatus.FOUND, "")
            found.headers["Location"] = f"./{token}"  # relative: a proxy may serve it below a path of its own
        elif path == "/":
            found = connection.respond(HTTPStatus.OK, self._page(nonce))
            del found.headers["Content-Type"]
            found.headers["Content-Type"] = "text/html; charset=utf-8"
        else:
            found = connection.respond(HTTPStatus.NOT_FOUND, "there is nothing here\n")
        return found

    def _talk(self, connection: Any) -> None:
        with self._lock:
            self._pages += 1
        client = Client(connection)
        try:
            self._opened(client)
            for text in connection:
                try:
                    message = json.loads(text)
                except (ValueError, RecursionError):
                    message = None
                self._said(client, message if isinstance(message, dict) else {})
        finally:
            with self._lock:
                self._pages -= 1
            client.close()
            self._closed(client)


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


def _free_port(host: str, port: int) -> int:
    """Return the first port from this one on that can be listened on."""
    if not 1 <= port <= LAST_PORT:
        raise OutputError(f"--port {port}: must be from 1 to {LAST_PORT}")
    fault: Exception | None = None
    for tried in range(port, min(port + PORTS, LAST_PORT + 1)):
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
