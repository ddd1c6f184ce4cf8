"""The server of the page: it connects people's browsers with the process of the game."""

import asyncio
import json
import pickle
import secrets
import select
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from hashlib import blake2b
from ipaddress import ip_address
from itertools import count
from math import isfinite
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final
from urllib.parse import quote, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.requests import HTTPConnection, Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import Lifespan
from starlette.websockets import WebSocket, WebSocketDisconnect

from ...core import pack_plainly
from ...errors import OptionValueError, ProcessDiedError, StoreError
from .forms import Message
from .game import Game
from .host import Rules, run_game

MOST_PAGES: Final = 64
"""The largest number of open pages. One more closes the page of the oldest spectator."""

MOST_CONNECTIONS: Final = 200
"""The largest number of connections. Requests of further ones are refused."""

LONGEST_MESSAGE: Final = 65_536
"""The largest number of bytes of a message."""

PAUSE: Final = 0.05
"""The seconds between two messages of a page."""

MOST_WAITING: Final = 4
"""The largest number of messages of a page that wait for the game."""

INVALID: Final = "the message is not one of this page"
"""The answer to an invalid message."""

STRANGER: Final = "the link of this page has no key of this game: ask for the link of your seat"
"""The answer to a message without a key."""

MOVES: Final = ("act", "rule", "undo", "redo", "jump", "restart", "again")
"""The messages after which the simulation may compute."""

FILES: Final = ("/page.js", "/view.js", "/inputs.js", "/charts.js", "/link.js", "/page.css")
"""The files of the page."""

PATHS: Final = ("/", "/watch", "/facilitator", "/seat/{seat:path}")
"""The paths of the page, which shows a lobby, a seat, or the game alone."""

HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:;"
        " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",  # because the address has the key of a seat
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Link:
    """A connection to a page.

    Of each type of message, only the latest waits to be sent, because it replaces those before.
    """

    def __init__(self, websocket: WebSocket) -> None:
        """Make the link of an accepted websocket."""
        self.websocket = websocket
        self.turns = asyncio.Semaphore(MOST_WAITING)  # one for each message to the game
        self._outbox: dict[str, str] = {}
        self._ready = asyncio.Event()

    def send(self, kind: str, text: str) -> None:
        """Send a message soon, after all that wait."""
        self._outbox.pop(kind, None)
        self._outbox[kind] = text
        self._ready.set()

    async def write(self) -> None:
        """Send messages until the task is cancelled, or the page is gone."""
        with suppress(WebSocketDisconnect, RuntimeError):  # the reader notices these, too
            while await self._ready.wait():
                self._ready.clear()
                texts = list(self._outbox.values())
                self._outbox.clear()
                for text in texts:
                    await self.websocket.send_text(text)


def secret_of(record: Path) -> bytes:
    """Return the secret of a recorded game, from a file beside the recording.

    Raises:
        StoreError: The file cannot be read or written.
    """
    path = record.with_name(f"{record.name}.keys")
    try:
        if not path.exists():
            path.touch(mode=0o600)
            path.write_text(secrets.token_hex(32))
        secret = bytes.fromhex(path.read_text())
        if len(secret) != 32:
            raise ValueError("it has no secret of 32 bytes")
    except (OSError, ValueError) as error:
        raise StoreError(f"the keys {path} cannot be read: {error!r}") from error
    return secret


class Table:
    """The links to all pages, around the connection to the game."""

    def __init__(
        self,
        connection: Connection,
        state: Message,
        announce: Callable[[str], None],
        secret: bytes | None = None,
        *,
        is_open: bool = True,
    ) -> None:
        """Take over the game's connection.

        Args:
            connection: The connection to the game.
            state: The first state of the game.
            announce: A function that is called with the path of each seat.
            secret: The secret of the seats' keys. None: a random one.
            is_open: Whether the lobby gives free seats to all who ask.
        """
        self.links: dict[int, Link] = {}
        self.latest: dict[str, str] = {}  # the latest message of each type, for newcomers
        self._connection = connection
        self._announce = announce
        self._is_open = is_open
        self._secret = secret or secrets.token_bytes(32)
        self._owners: dict[str, str] = {}  # the seat of each key; "" for the facilitator
        self._opened: dict[str, None] = {}  # the seats whose pages were open at any time
        self._seats: dict[int, str] = {}  # of the links; spectators have none
        self._numbers = count(1)
        self._writer = ThreadPoolExecutor(1)  # because the game may not read
        self._show(state)

    async def serve(self, websocket: WebSocket) -> None:
        """Serve a page until it is gone."""
        await websocket.accept()
        link = Link(websocket)
        number = next(self._numbers)
        if len(self.links) >= MOST_PAGES:
            spectators = (self.links[other] for other in self.links if other not in self._seats)
            with suppress(RuntimeError):
                await next(spectators, link).websocket.close(1013)  # try again later
        self.links[number] = link
        for kind, text in self.latest.items():
            link.send(kind, text)
        self._tell_people()
        writer = asyncio.create_task(link.write())
        try:
            while (message := await websocket.receive())["type"] == "websocket.receive":
                problem = await self._pass_on(number, message.get("text") or "")
                if problem:
                    _send({"type": "error", "text": problem}, link)
                await asyncio.sleep(PAUSE)
        except RuntimeError:  # this server has closed the page
            pass
        finally:
            writer.cancel()
            del self.links[number]
            self._seats.pop(number, None)
            self._tell_people()

    async def _pass_on(self, number: int, text: str) -> str:
        """Check a message, and pass it on to the game; return the problem, or ""."""
        link = self.links[number]
        try:
            match json.loads(text, parse_constant=str, parse_float=_finite):
                case {"do": "claim", "seat": str(seat)} if seat and seat in self._owners.values():
                    if not self._is_open or seat in self._seats.values():
                        return f"{seat} needs the link of this seat: ask for it"
                    _send({"type": "link", "path": self._path(seat)}, link)
                    return ""
                case {"key": str(key), **message}:
                    owner = self._owners.get(key)
                    parcel = pickle.dumps((number, owner, message))  # it may be too deep
                case _:
                    return INVALID
        except (ValueError, RecursionError):
            return INVALID
        if owner is None or message.get("seat", owner) != owner:
            _send({"type": "error", "text": STRANGER, "stranger": True}, link)
        elif message.get("do") == "take":
            if owner:
                self._seats[number] = owner
                self._opened[owner] = None
            _send({"type": "you", "seat": owner}, link)
            self._tell_people()
        elif link.turns.locked():
            return "the game is busy; try again"
        else:
            await link.turns.acquire()
            self._write(parcel)
            if message.get("do") in MOVES:
                self._send_all({"type": "busy", "on": True})
        return ""

    def _tell_people(self) -> None:
        """Tell pages and game which seats people have."""
        people = Counter(self._seats.values())
        spectators = len(self.links) - people.total()
        self._send_all(
            {
                "type": "people",
                "spectators": spectators,
                "taken": people,
                "opened": list(self._opened),
                "open": self._is_open,
            }
        )
        self._write(pickle.dumps((None, None, {"taken": people})))

    def _write(self, parcel: bytes) -> None:
        self._writer.submit(Connection.send_bytes, self._connection, parcel)

    def _show(self, message: Message) -> None:
        if message["type"] == "state":
            self.latest.pop("busy", None)
            facilitators = [""] if message.get("tools") == "facilitator" else []
            for seat in [*facilitators, *message.get("seats", ())]:
                if seat not in self._owners.values():
                    self._owners[self._key(seat)] = seat
                    self._announce(self._path(seat))
        self._send_all(message)

    def _key(self, seat: str) -> str:
        """Return the key of a seat, which is the same when a recording is resumed."""
        name = seat.encode(errors="backslashreplace")
        return blake2b(name, key=self._secret, digest_size=16).hexdigest()

    def _path(self, seat: str) -> str:
        """Return the path of a seat's page, with its key."""
        name = f"seat/{quote(seat, safe='', errors='replace')}" if seat else "facilitator"
        return f"/{name}?key={self._key(seat)}"

    def _send_all(self, message: Message) -> None:
        self.latest[message["type"]] = _send(message, *self.links.values())

    async def read_game(self) -> None:
        """Show the messages of the game, until it ends."""
        with suppress(EOFError, OSError):
            while True:
                number, message = await asyncio.to_thread(self._connection.recv)
                links = [self.links[number]] if number in self.links else []  # the page is gone
                for link in links:
                    link.turns.release()
                if number is not None and message is not None:
                    self._send_all({"type": "busy", "on": False})
                    _send(message, *links)
                elif message is not None:
                    self._show(message)


def _send(message: Message, *links: Link) -> str:
    """Send a message to pages; return its text."""
    text = json.dumps(message, allow_nan=False)
    for link in links:
        link.send(message["type"], text)
    return text


def _finite(text: str) -> float | str:
    """Return a number of JSON; if it is too large, its text."""
    number = float(text)
    return number if isfinite(number) else text


class _Server(uvicorn.Server):
    def exit_soon(self, reader: asyncio.Task[None]) -> None:
        """Exit, because the reader of the game has ended."""
        self.should_exit = True


def make_app(table: Table, host: str, lifespan: Lifespan[Starlette]) -> Starlette:
    """Make the application. It answers only requests to its own names and from its own pages."""
    names = {"localhost", host.lower(), socket.gethostname().lower()}

    async def page(request: Request) -> Response:
        if not _is_own(request, names):
            return PlainTextResponse("This server has another name.", 403)
        file = request.url.path[1:] if request.url.path in FILES else "page.html"
        return FileResponse(Path(__file__).with_name(file), headers=HEADERS)

    async def messages(websocket: WebSocket) -> None:
        if _is_own(websocket, names):
            await table.serve(websocket)
        else:
            await websocket.close()

    pages = [Route(path, page) for path in (*PATHS, *FILES)]
    return Starlette(routes=[*pages, WebSocketRoute("/ws", messages)], lifespan=lifespan)


def _is_own(connection: HTTPConnection, names: set[str]) -> bool:
    """Return whether the Host header has a name of this server, or an address, as the Origin has.

    An address is safe, because only a name can be bound to another server.
    """
    netloc = connection.headers.get("host", "")
    origin = connection.headers.get("origin", "")
    try:
        name = (urlsplit(f"//{netloc}").hostname or "").lower()
        is_own = name in names or bool(ip_address(name))
    except ValueError:
        return False
    return is_own and (not origin or origin.partition("//")[2] == netloc)


def serve(
    make: Callable[[], tuple[Game, Rules]],
    *,
    host: str,
    port: int,
    record: Path | None,
) -> str:
    """Serve a game until an interrupt; return a summary.

    Args:
        make: A function that makes the game. It is called in the process that plays.
        host: The address to listen on.
        port: The port; 0: any free one.
        record: The file of the recording, beside which the keys are kept.

    Raises:
        OptionValueError: An option has an invalid value, or the simulation cannot be played.
        StoreError: The keys cannot be read.
        ProcessDiedError: The process that plays has ended.
    """
    if not 0 <= port < 65_536:
        raise OptionValueError(f"there is no port {port}")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        raise OptionValueError(f"cannot listen on {host}, port {port}: {error}") from error
    # A spawned process inherits neither threads nor sockets, which clones would copy.
    context = get_context("spawn")
    connection, game_connection = context.Pipe()
    process = context.Process(target=run_game, args=(game_connection, pack_plainly(make)))
    process.start()
    game_connection.close()

    def end_game() -> None:
        with suppress(OSError):
            if select.select([], [connection], [], 0)[1]:  # else it does not read, and is killed
                connection.send((None, None, None))
        process.join(2.0)
        process.kill()
        process.join()

    try:
        _, state = connection.recv()
        if state["type"] == "failed":
            raise OptionValueError(state["text"])
        secret = None if record is None else secret_of(record)
        address, bound, *_ = listener.getsockname()
        shown_host = f"[{host}]" if ":" in host else host
        if ip_address(address).is_unspecified:
            shown_host = socket.gethostname()
        base = f"http://{shown_host}:{bound}"
        if state["resumed"]:
            print(f"The game of {record} goes on, with seed {state['seed']}.", flush=True)
        print(f"Take a seat or watch at {base}/ or play at the link of a seat:", flush=True)

        def announce(path: str) -> None:
            print(f"  {base}{path}", flush=True)

        table = Table(connection, state, announce, secret, is_open=ip_address(address).is_loopback)
        _run(table, host, listener, end_game)
    except EOFError:
        process.join()
        raise ProcessDiedError(
            f"the process of the game has ended, with exit code {process.exitcode}"
        ) from None
    finally:
        end_game()
        listener.close()
    returns = json.loads(table.latest["state"])["returns"]
    return "The returns: " + ", ".join(f"{agent} {total:g}" for agent, total in returns.items())


def _run(
    table: Table,
    host: str,
    listener: socket.socket,
    end_game: Callable[[], None],
) -> None:
    """Serve until an interrupt.

    Raises:
        EOFError: The game has ended before.
    """
    died = False

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        nonlocal died
        reader = asyncio.create_task(table.read_game())
        reader.add_done_callback(server.exit_soon)
        yield
        died = reader.done()
        await asyncio.to_thread(end_game)
        await reader

    config = uvicorn.Config(
        make_app(table, host, lifespan),
        lifespan="on",
        limit_concurrency=MOST_CONNECTIONS,
        log_level="error",
        server_header=False,
        timeout_graceful_shutdown=1,
        ws_max_size=LONGEST_MESSAGE,
    )
    server = _Server(config)
    with suppress(KeyboardInterrupt):
        server.run(sockets=[listener])
    if died:
        raise EOFError
