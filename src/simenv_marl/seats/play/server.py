"""The server: the page for each seat and for spectators, and what goes between them and the game."""

from __future__ import annotations

import asyncio
import hmac
import json
import secrets
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from ipaddress import ip_address
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from time import monotonic
from typing import Any, Final
from urllib.parse import quote, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from ...errors import OptionValueError, ProcessDiedError, short_repr
from .game import run_game

MOST_LINKS: Final = 64
"""The most open pages. A new one closes the page of the spectator who came first."""

MOST_CONNECTIONS: Final = 200
"""The most connections, also those that have asked for nothing yet. They have ``PATIENCE`` seconds to do so."""

PATIENCE: Final = 10.0

LONGEST: Final = 65_536
"""The most bytes of a message."""

RATE, BURST = 20.0, 40.0
"""How many messages a second the server reads from a page, and how many more at once."""

OPEN: Final = 4
"""How many messages of a page the game may have before it."""

FILES: Final = {"page.html": "text/html", "page.js": "text/javascript", "page.css": "text/css"}

HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:;"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",  # the address has the key of a seat
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Link:
    """A connection to a page. Of each type of message, only the latest waits to be sent."""

    def __init__(self, websocket: WebSocket) -> None:
        self.websocket, self.seat = websocket, ""
        self.waiting: dict[str, str] = {}
        self.ready = asyncio.Event()
        self.open, self.allowed, self.asked_at = 0, BURST, monotonic()

    def send(self, kind: str, text: str) -> None:
        """Send a message of a type soon."""
        self.waiting.pop(kind, None)
        self.waiting[kind] = text
        self.ready.set()

    async def write(self) -> None:
        """Send messages until the task is cancelled."""
        with suppress(WebSocketDisconnect, RuntimeError):  # the reader notices the end
            while await self.ready.wait():
                self.ready.clear()
                waiting, self.waiting = self.waiting, {}
                for text in waiting.values():
                    await self.websocket.send_text(text)

    async def read(self) -> str:
        """Wait for a message; longer, if too many have come."""
        now = monotonic()
        self.allowed, self.asked_at = min(BURST, self.allowed + (now - self.asked_at) * RATE) - 1, now
        await asyncio.sleep(max(0.0, -self.allowed / RATE))
        message = await self.websocket.receive()
        if message["type"] == "websocket.disconnect":
            raise WebSocketDisconnect
        return message.get("text") or ""


class Table:
    """Links to pages, around a connection to the game."""

    def __init__(self, connection: Any, state: dict[str, Any], announce: Callable[[str], None]) -> None:
        """Take over the game's connection and its first state; ``announce`` is called with each seat that there is."""
        self.connection, self.announce, self.secret = connection, announce, secrets.token_bytes(32)
        self.links: dict[int, Link] = {}
        self.numbers = count(1)
        self.latest: dict[str, str] = {}  # by type, for those who come
        self.seats: set[str] = set()
        self.inbox: asyncio.Queue[Any] = asyncio.Queue()  # of the game; each link has few messages in it
        self.taken: Counter[str] | None = None  # as the game is going to be told; None: it is not
        self._show(state)

    def key(self, seat: str) -> str:
        """Return the key of a seat."""
        return hmac.digest(self.secret, seat.encode(errors="replace"), "sha256").hex()[:32]

    async def serve(self, websocket: WebSocket) -> None:
        """Serve a page."""
        await websocket.accept()
        link, number = Link(websocket), next(self.numbers)
        if len(self.links) >= MOST_LINKS:
            oldest = next((one for one in self.links.values() if not one.seat), link)
            with suppress(RuntimeError):
                await oldest.websocket.close(1013)
        self.links[number] = link
        for kind, text in self.latest.items():
            link.send(kind, text)
        self._tell_people()
        writer = asyncio.create_task(link.write())
        try:
            while True:
                self._take(number, link, await link.read())
        except (WebSocketDisconnect, RuntimeError):  # also one that this server has closed
            pass
        finally:
            writer.cancel()
            del self.links[number]
            self._tell_people()

    def _take(self, number: int, link: Link, text: str) -> None:
        """Check a message, and pass it on to the game."""
        try:
            message = json.loads(text, parse_constant=lambda name: name)
            seat, key = str(message.pop("seat")), str(message.pop("key"))
        except (ValueError, RecursionError, TypeError, LookupError, AttributeError):
            problem = "the message is not one of this page"
        else:
            if seat not in self.seats or not hmac.compare_digest(self.key(seat).encode(), key.encode(errors="replace")):
                problem = "the link of this page has no key of this game: ask for the link of your seat"
            elif message.get("do") == "take":
                link.seat, problem = seat, ""
                self._tell_people()
            elif link.open >= OPEN:
                problem = "the game is busy; try again"
            else:
                link.open, problem = link.open + 1, ""
                self.inbox.put_nowait((number, seat, message))
        if problem:
            link.send("error", json.dumps({"type": "error", "text": problem}))

    def _tell_people(self) -> None:
        """Tell pages and game who is there."""
        taken = Counter(link.seat for link in self.links.values())
        people = {"type": "people", "spectators": taken.pop("", 0), "taken": taken}
        self._send_all("people", json.dumps(people))
        if self.taken is None:
            self.inbox.put_nowait((None, None, {}))
        self.taken = taken

    def _show(self, message: dict[str, Any]) -> None:
        for seat in message.get("seats", ()) if message["type"] == "state" else ():
            if seat not in self.seats:
                self.seats.add(seat)
                self.announce(f"/seat/{quote(seat, safe='')}?key={self.key(seat)}")
        self._send_all(message["type"], json.dumps(message))

    def _send_all(self, kind: str, text: str) -> None:
        self.latest[kind] = text
        for link in self.links.values():
            link.send(kind, text)

    async def read_game(self) -> None:
        """Show what the game says, until it ends."""
        with suppress(EOFError, OSError):
            while True:
                number, message = await asyncio.to_thread(self.connection.recv)
                link = self.links.get(number)
                if number is None and message is not None:
                    self._show(message)
                elif link is not None:
                    link.open -= 1
                    if message is not None:
                        link.send("error", json.dumps(message))

    async def write_game(self) -> None:
        """Pass messages on to the game."""
        with suppress(OSError):
            while True:
                number, seat, message = await self.inbox.get()
                if seat is None:
                    message, self.taken = {"taken": list(self.taken or ())}, None
                await asyncio.to_thread(self.connection.send, (number, seat, message))


class _Protocol(H11Protocol):
    """HTTP that closes connections which ask for nothing, or are too many."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()
        self.loop.call_later(PATIENCE, lambda: self.cycle is None and self in self.connections and transport.abort())


def make_app(table: Table, host: str, lifespan: Any = None) -> Any:
    """Make the application, which answers only to its own names, and only to its own pages."""
    folder = Path(__file__).parent
    texts = {name: (folder / name).read_bytes() for name in FILES}

    async def page(request: Any) -> Response:
        name = request.url.path[1:] if request.url.path[1:] in FILES else "page.html"
        return Response(texts[name], media_type=FILES[name], headers=HEADERS)

    paths = ["/", "/seat/{seat}", "/page.js", "/page.css"]
    app = Starlette(routes=[*(Route(path, page) for path in paths), WebSocketRoute("/ws", table.serve)], lifespan=lifespan)
    names = {"localhost", host.lower(), socket.gethostname().lower()}

    async def guarded(scope: Any, receive: Any, send: Any) -> None:
        headers = dict(scope.get("headers", ()))
        asked, origin = headers.get(b"host", b"").decode("latin-1"), headers.get(b"origin", b"").decode("latin-1")
        known = scope["type"] == "lifespan" or _host_of(asked) in names or _is_address(_host_of(asked))
        if known and (not origin or origin.partition("//")[2] == asked):
            await app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await PlainTextResponse("This server has another name.", 403)(scope, receive, send)

    return guarded


def _host_of(netloc: str) -> str:
    try:
        return (urlsplit(f"//{netloc}").hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    """Whether a name is an address, which nobody can bind to another server."""
    with suppress(ValueError):
        return bool(ip_address(name))
    return False


def play(
    find: Callable[[], Any],
    *,
    name: str,
    seats: Sequence[str] = (),
    seed: int | None = None,
    host: str = "127.0.0.1",
    port: int = 8000,
    limit: float | None = None,
    record: Path | None = None,
) -> str:
    """Play until an interrupt; return a summary. ``find`` returns the simulation, in a process that this one starts.

    Raises:
        OptionValueError: An option has an invalid value, or the simulation cannot be played.
        ProcessDiedError: The process with the simulation has ended.
    """
    if limit is not None and not 0 < limit < 1e6:
        raise OptionValueError(f"limit must be a positive number of seconds, not {short_repr(limit)}")
    context = get_context("spawn")  # which inherits nothing: neither threads nor sockets reach the clones
    connection, there = context.Pipe()
    chosen = secrets.randbelow(2**31) if seed is None else seed
    options = {"name": name, "seats": list(seats), "seed": chosen, "limit": limit, "record": record}
    process = context.Process(target=run_game, args=(there, find, options))
    process.start()
    there.close()

    def end() -> None:
        with suppress(OSError):
            connection.send((None, None, None))
        process.join(2.0)
        process.kill()
        process.join()

    try:
        _, state = connection.recv()
        if state["type"] == "failed":
            raise OptionValueError(state["text"])
        with socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET) as listening:
            shown = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
            base = f"http://{shown}:{listening.getsockname()[1]}"
            print(f"Everybody sees the game at {base}/ and plays at the link of a seat:", flush=True)
            table = Table(connection, state, lambda link: print(f"  {base}{link}", flush=True))
            _run(table, host, listening, end)
    except EOFError:
        raise ProcessDiedError(f"the process of {name} has ended, with exit code {process.exitcode}") from None
    except (OSError, OverflowError) as error:
        raise OptionValueError(f"nobody can connect to {host}, port {port}: {error}") from error
    finally:
        end()
    returns = json.loads(table.latest["state"])["returns"]
    return f"The end of {name}, seed {chosen}: " + ", ".join(f"{agent} {total:g}" for agent, total in returns.items())


def _run(table: Table, host: str, listening: socket.socket, end: Callable[[], None]) -> None:
    """Serve until an interrupt, or raise ``EOFError`` if the game ends before."""

    @asynccontextmanager
    async def lifespan(app: Any) -> AsyncIterator[None]:
        reader, writer = asyncio.create_task(table.read_game()), asyncio.create_task(table.write_game())
        reader.add_done_callback(lambda task: setattr(server, "should_exit", True))
        yield
        ended.append(reader.done())
        await asyncio.to_thread(end)
        writer.cancel()
        await reader

    ended: list[bool] = []
    server = uvicorn.Server(
        uvicorn.Config(
            make_app(table, host, lifespan), http=_Protocol, log_level="error", ws_max_size=LONGEST, lifespan="on",
            server_header=False, timeout_graceful_shutdown=1,
        )
    )  # fmt: skip
    with suppress(KeyboardInterrupt):
        server.run(sockets=[listening])
    if ended == [True]:
        raise EOFError
