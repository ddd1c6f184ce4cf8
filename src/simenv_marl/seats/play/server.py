"""The server: the page for each seat and for spectators, and what goes between them and the game."""

from __future__ import annotations

import asyncio
import hmac
import json
import pickle
import secrets
import select
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from ipaddress import ip_address
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from ...errors import OptionValueError, ProcessDiedError
from .game import run_game

PAGES: Final = 64  # that are open; one more closes that of the spectator who came first
CONNECTIONS: Final = 200
PATIENCE: Final = 10.0  # seconds in which a connection must ask for something
LONGEST: Final = 65_536  # bytes of a message
PAUSE: Final = 0.05  # seconds between two messages of a page
OPEN: Final = 4  # messages of a page that the game may have before it
FILES: Final = {"/page.js": "text/javascript", "/page.css": "text/css"}
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
        self.websocket, self.seat, self.open = websocket, "", 0
        self.waiting: dict[str, str] = {}
        self.ready = asyncio.Event()

    def send(self, kind: str, text: str) -> None:
        """Send a message soon."""
        self.waiting[kind] = text
        self.ready.set()

    async def write(self) -> None:
        """Send messages until the task is cancelled, or the page is gone, which the reader notices, too."""
        with suppress(WebSocketDisconnect, RuntimeError):
            while await self.ready.wait():
                self.ready.clear()
                waiting, self.waiting = self.waiting, {}
                for text in waiting.values():
                    await self.websocket.send_text(text)


class Table:
    """Links to pages, around a connection to the game."""

    def __init__(
        self, connection: Any, state: dict[str, Any], announce: Callable[[str], None]
    ) -> None:
        """Take over the game's connection and its first state.

        ``announce`` is called with the path of each seat.
        """
        self.connection, self.announce, self.secret = connection, announce, secrets.token_bytes(32)
        self.links: dict[int, Link] = {}
        self.numbers = count(1)
        self.latest: dict[str, str] = {}  # by type of message, for those who come
        self.seats: set[str] = set()
        # of the game; each link has few messages in it
        self.inbox: asyncio.Queue[Any] = asyncio.Queue()
        self.taken: Counter[str] | None = None  # seats of which the game is to be told
        self._show(state)

    def key(self, seat: str) -> str:
        """Return the key of a seat."""
        return hmac.digest(self.secret, seat.encode(errors="replace"), "sha256").hex()[:32]

    async def serve(self, websocket: WebSocket) -> None:
        """Serve a page."""
        await websocket.accept()
        link, number = Link(websocket), next(self.numbers)
        if len(self.links) >= PAGES:
            oldest = next((one for one in self.links.values() if not one.seat), link)
            with suppress(RuntimeError):
                await oldest.websocket.close(1013)
        self.links[number] = link
        for kind, text in self.latest.items():
            link.send(kind, text)
        self._tell_people()
        writer = asyncio.create_task(link.write())
        try:
            while (message := await websocket.receive())["type"] == "websocket.receive":
                problem = self._take(number, link, message.get("text") or "")
                if problem:
                    link.send("error", json.dumps({"type": "error", "text": problem}))
                await asyncio.sleep(PAUSE)
        except RuntimeError:  # this server has closed it
            pass
        finally:
            writer.cancel()
            del self.links[number]
            self._tell_people()

    def _take(self, number: int, link: Link, text: str) -> str:
        """Check a message, and pass it on to the game; return what is wrong."""
        try:
            message = json.loads(text, parse_constant=str)
            seat, key = str(message.pop("seat")), str(message.pop("key"))
            parcel = pickle.dumps((number, seat, message))  # not later, because it may be too deep
        except (ValueError, RecursionError, TypeError, LookupError, AttributeError):
            return "the message is not one of this page"
        if seat not in self.seats or not hmac.compare_digest(
            self.key(seat).encode(), key.encode(errors="replace")
        ):
            return "the link of this page has no key of this game: ask for the link of your seat"
        if message.get("do") == "take":
            link.seat = seat
            self._tell_people()
        elif link.open >= OPEN or self.inbox.qsize() > OPEN * PAGES:
            return "the game is busy; try again"
        else:
            link.open += 1
            self.inbox.put_nowait(parcel)
        return ""

    def _tell_people(self) -> None:
        """Tell pages and game who is there."""
        taken = Counter(link.seat for link in self.links.values())
        self._send_all(
            json.dumps({"type": "people", "spectators": taken.pop("", 0), "taken": taken}), "people"
        )
        if self.taken is None:
            self.inbox.put_nowait(None)
        self.taken = taken

    def _show(self, message: dict[str, Any]) -> None:
        for seat in message.get("seats", ()):
            if seat not in self.seats:
                self.announce(f"/seat/{quote(seat, safe='')}?key={self.key(seat)}")
            self.seats.add(seat)
        self._send_all(json.dumps(message), message["type"])

    def _send_all(self, text: str, kind: str) -> None:
        self.latest[kind] = text
        for link in self.links.values():
            link.send(kind, text)

    async def read_game(self) -> None:
        """Show what the game says, until it ends."""
        with suppress(EOFError, OSError):
            while True:
                number, message = await asyncio.to_thread(self.connection.recv)
                link = self.links.get(number)
                if link is not None:
                    link.open -= 1
                if link is not None and message is not None:
                    link.send("error", json.dumps(message))
                elif number is None and message is not None:
                    self._show(message)

    async def write_game(self) -> None:
        """Pass messages on to the game."""
        with suppress(OSError):
            while True:
                parcel = await self.inbox.get()
                if parcel is None:
                    parcel, self.taken = pickle.dumps((None, None, {"taken": self.taken})), None
                await asyncio.to_thread(self.connection.send_bytes, parcel)


class _Protocol(H11Protocol):
    """HTTP that closes connections which ask for nothing, or are too many."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if len(self.connections) > CONNECTIONS:
            transport.abort()
        self.loop.call_later(
            PATIENCE, lambda: self.cycle is None and self in self.connections and transport.abort()
        )


def make_app(table: Table, host: str, lifespan: Any = None) -> Any:
    """Make the application, which answers only to its own names, and only to its own pages."""
    texts = {
        path: Path(__file__).with_name(path[1:]).read_bytes() for path in ("/page.html", *FILES)
    }

    async def page(request: Any) -> Response:
        path = request.url.path
        return Response(
            texts.get(path, texts["/page.html"]),
            media_type=FILES.get(path, "text/html"),
            headers=HEADERS,
        )

    routes = [Route(path, page) for path in ("/", "/seat/{seat}", *FILES)]
    app = Starlette(routes=[*routes, WebSocketRoute("/ws", table.serve)], lifespan=lifespan)
    names = {"localhost", host.lower(), socket.gethostname().lower()}

    async def guarded(scope: Any, receive: Any, send: Any) -> None:
        headers = {name: value.decode("latin-1") for name, value in scope.get("headers", ())}
        asked, origin = headers.get(b"host", ""), headers.get(b"origin", "")
        same = not origin or origin.partition("//")[2] == asked
        if scope["type"] == "lifespan" or (same and _is_own(asked, names)):
            await app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await PlainTextResponse("This server has another name.", 403)(scope, receive, send)

    return guarded


def _is_own(netloc: str, names: set[str]) -> bool:
    """Whether a Host header has a name of this server, or an address: only a name can be bound to another server."""
    try:
        name = (urlsplit(f"//{netloc}").hostname or "").lower()
        return name in names or bool(ip_address(name))
    except ValueError:
        return False


def play(find: Callable[[], Any], *, seed: int | None, host: str, port: int, **options: Any) -> str:
    """Play until an interrupt; return a summary.

    Args:
        find: A callable that returns the simulation. It is pickled, and called in the process that
            plays.
        seed: The seed of the first episode; None: a random one.
        host: The address to listen on.
        port: The port; 0: any free one.
        **options: The other options of ``Game``.

    Raises:
        OptionValueError: An option has an invalid value, or the simulation cannot be played.
        ProcessDiedError: The process that plays has ended.
    """
    if not 0 <= port < 65_536:
        raise OptionValueError(f"there is no port {port}")
    # which inherits nothing: neither threads nor sockets reach the clones
    context = get_context("spawn")
    connection, there = context.Pipe()
    options["seed"] = secrets.randbelow(2**31) if seed is None else seed
    process = context.Process(target=run_game, args=(there, find, options))
    process.start()
    there.close()

    def end() -> None:
        with suppress(OSError):
            if select.select([], [connection], [], 0)[1]:  # a game that does not read is killed
                connection.send((None, None, None))
        process.join(2.0)
        process.kill()
        process.join()

    try:
        _, state = connection.recv()
        if state["type"] == "failed":
            raise OptionValueError(state["text"])
        with socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        ) as listening:
            shown = (
                socket.gethostname()
                if host in ("0.0.0.0", "::")
                else f"[{host}]"
                if ":" in host
                else host
            )
            base = f"http://{shown}:{listening.getsockname()[1]}"
            print(
                f"Everybody sees the game at {base}/ and plays at the link of a seat:", flush=True
            )
            table = Table(connection, state, lambda path: print(f"  {base}{path}", flush=True))
            _run(table, host, listening, end)
    except EOFError:
        process.join()
        raise ProcessDiedError(
            f"the process of the game has ended, with exit code {process.exitcode}"
        ) from None
    except OSError as error:
        raise OptionValueError(f"nobody can connect to {host}, port {port}: {error}") from error
    finally:
        end()
    returns = json.loads(table.latest["state"])["returns"]
    return "The returns: " + ", ".join(f"{agent} {total:g}" for agent, total in returns.items())


def _run(table: Table, host: str, listening: socket.socket, end: Callable[[], None]) -> None:
    """Serve until an interrupt, or raise ``EOFError`` if the game ends before."""
    died = []

    @asynccontextmanager
    async def lifespan(app: Any) -> AsyncIterator[None]:
        reader, _writer = (
            asyncio.create_task(table.read_game()),
            asyncio.create_task(table.write_game()),
        )
        reader.add_done_callback(lambda task: setattr(server, "should_exit", True))
        yield
        died.append(reader.done())
        await asyncio.to_thread(end)
        await reader

    config: dict[str, Any] = {
        "http": _Protocol,
        "ws_max_size": LONGEST,
        "timeout_graceful_shutdown": 1,
    }
    quiet: dict[str, Any] = {"log_level": "error", "server_header": False, "lifespan": "on"}
    server = uvicorn.Server(uvicorn.Config(make_app(table, host, lifespan), **config, **quiet))
    with suppress(KeyboardInterrupt):
        server.run(sockets=[listening])
    if any(died):
        raise EOFError
