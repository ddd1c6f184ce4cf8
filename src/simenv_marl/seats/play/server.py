"""The server of the page: it connects people's browsers with the process of the game."""

import asyncio
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
from math import isfinite
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final
from urllib.parse import quote, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp, Lifespan, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from ...core import pack_plainly
from ...errors import OptionValueError, ProcessDiedError, SimEnvError, StoreError
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


class Keys:
    """The keys in the links of a game, which are the same when a recording is resumed.

    Attributes:
        seats: The seat of each key; "" for the facilitator.
    """

    def __init__(self, path: Path | None) -> None:
        """Use a file, which need not exist; None: there is none.

        Raises:
            StoreError: The file cannot be read.
        """
        self.seats: dict[str, str] = {}
        self._path = path
        if path is not None and path.exists():
            try:
                self.seats = dict(json.loads(path.read_text(encoding="utf-8")))
            except (OSError, ValueError, TypeError) as error:
                raise StoreError(f"the keys {path} cannot be read: {error!r}") from error

    def link(self, seat: str) -> str:
        """Return the path of a seat's page, with its key."""
        keys = {seat: key for key, seat in self.seats.items()}
        if seat not in keys:
            keys[seat] = secrets.token_hex(16)
            self.seats[keys[seat]] = seat
            self._save()
        name = f"seat/{quote(seat, safe='', errors='replace')}" if seat else "facilitator"
        return f"/{name}?key={keys[seat]}"

    def _save(self) -> None:
        if self._path is not None:
            self._path.touch(mode=0o600)
            self._path.write_text(json.dumps(self.seats), encoding="utf-8")


class Table:
    """The links to all pages, around the connection to the game."""

    def __init__(
        self,
        connection: Connection,
        state: Message,
        announce: Callable[[str], None],
        keys: Keys | None = None,
        *,
        is_open: bool = True,
    ) -> None:
        """Take over the game's connection.

        Args:
            connection: The connection to the game.
            state: The first state of the game.
            announce: A function that is called with the path of each seat.
            keys: The keys of the seats.
            is_open: Whether the lobby gives free seats to all who ask.
        """
        self.links: dict[int, Link] = {}
        self.latest: dict[str, str] = {}  # the latest message of each type, for newcomers
        self._connection = connection
        self._announce = announce
        self._is_open = is_open
        self._keys = keys or Keys(None)
        self._announced: set[str] = set()
        self._opened: dict[str, None] = {}  # the seats whose pages were open at any time
        self._seats: dict[int, str] = {}  # of the links; spectators have none
        self._waiting: Counter[int] = Counter()  # messages of each link that wait for the game
        self._numbers = count(1)
        self._inbox: asyncio.Queue[bytes] = asyncio.Queue()
        self._show(state)

    async def serve(self, websocket: WebSocket) -> None:
        """Serve a page until it is gone."""
        await websocket.accept()
        link = Link(websocket)
        number = next(self._numbers)
        if len(self.links) >= MOST_PAGES:
            spectators = (self.links[other] for other in self.links if other not in self._seats)
            closed = next(spectators, link)
            with suppress(RuntimeError):
                await closed.websocket.close(1013)  # try again later
        self.links[number] = link
        for kind, text in self.latest.items():
            link.send(kind, text)
        self._tell_people()
        writer = asyncio.create_task(link.write())
        try:
            while (message := await websocket.receive())["type"] == "websocket.receive":
                problem = self._pass_on(number, message.get("text") or "")
                if problem:
                    link.send("error", json.dumps({"type": "error"} | problem))
                await asyncio.sleep(PAUSE)
        except RuntimeError:  # this server has closed the page
            pass
        finally:
            writer.cancel()
            del self.links[number], self._waiting[number]
            self._seats.pop(number, None)
            self._tell_people()

    def _pass_on(self, number: int, text: str) -> Message:
        """Check a message, and pass it on to the game; return the problem."""
        try:
            match json.loads(text, parse_constant=str, parse_float=_finite):
                case {"do": "claim", "seat": str(seat)}:
                    return self._claim(number, seat)
                case {"key": str(key), **message}:
                    owner = self._keys.seats.get(key)
                    parcel = pickle.dumps((number, owner, message))  # it may be too deep
                case _:
                    return {"text": INVALID}
        except (ValueError, RecursionError):
            return {"text": INVALID}
        if owner is None or message.get("seat", owner) != owner:
            return {"text": STRANGER, "stranger": True}
        if message.get("do") == "take":
            if owner:
                self._seats[number] = owner
                self._opened[owner] = None
            self.links[number].send("you", json.dumps({"type": "you", "seat": owner}))
            self._tell_people()
        elif self._waiting[number] >= MOST_WAITING:
            return {"text": "the game is busy; try again"}
        else:
            self._waiting[number] += 1
            self._inbox.put_nowait(parcel)
            if message.get("do") in MOVES:
                self._send_all({"type": "busy", "on": True})
        return {}

    def _claim(self, number: int, seat: str) -> Message:
        """Give a free seat to a page of the lobby; return the problem."""
        if seat not in self._announced:
            return {"text": INVALID}
        if not self._is_open or seat in self._seats.values():
            return {"text": f"{seat} needs the link of this seat: ask for it"}
        link = {"type": "link", "path": self._keys.link(seat)}
        self.links[number].send("link", json.dumps(link))
        return {}

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
        self._inbox.put_nowait(pickle.dumps((None, None, {"taken": people})))

    def _show(self, message: Message) -> None:
        if message["type"] == "state":
            self.latest.pop("busy", None)
            seats = ["", *message["seats"]] if message.get("tools") == "facilitator" else ()
            for seat in seats or message.get("seats", ()):
                if seat not in self._announced:
                    self._announced.add(seat)
                    self._announce(self._keys.link(seat))
        self._send_all(message)

    def _send_all(self, message: Message) -> None:
        kind = message["type"]
        text = self.latest[kind] = json.dumps(message, allow_nan=False)
        for link in self.links.values():
            link.send(kind, text)

    async def read_game(self) -> None:
        """Show the messages of the game, until it ends."""
        with suppress(EOFError, OSError):
            while True:
                number, message = await asyncio.to_thread(self._connection.recv)
                link = self.links.get(number)
                if link is not None:
                    self._waiting[number] -= 1
                if message is not None:
                    if number is None:
                        self._show(message)
                    else:
                        self._send_all({"type": "busy", "on": False})
                        if link is not None:
                            link.send("error", json.dumps(message))

    async def write_game(self) -> None:
        """Pass messages on to the game."""
        with suppress(OSError):
            while True:
                parcel = await self._inbox.get()
                await asyncio.to_thread(self._connection.send_bytes, parcel)


def _finite(text: str) -> float | str:
    """Return a number of JSON; if it is too large, its text."""
    number = float(text)
    return number if isfinite(number) else text


class _Server(uvicorn.Server):
    def exit_soon(self, reader: asyncio.Task[None]) -> None:
        """Exit, because the reader of the game has ended."""
        self.should_exit = True


def make_app(
    table: Table,
    host: str,
    lifespan: Lifespan[Starlette],
) -> ASGIApp:
    """Make the application. It answers only requests to its own names and from its own pages."""

    async def page(request: Request) -> FileResponse:
        path = request.url.path
        if path not in FILES:  # the page itself
            path = "/page.html"
        return FileResponse(Path(__file__).with_name(path[1:]), headers=HEADERS)

    routes: list[BaseRoute] = [Route(path, page) for path in (*PATHS, *FILES)]
    routes.append(WebSocketRoute("/ws", table.serve))
    app = Starlette(routes=routes, lifespan=lifespan)
    names = {"localhost", host.lower(), socket.gethostname().lower()}

    async def guarded(
        scope: Scope,
        receive: Receive,
        send: Send,
    ) -> None:
        headers = {name: value.decode("latin-1") for name, value in scope.get("headers", ())}
        netloc = headers.get(b"host", "")
        origin = headers.get(b"origin", "")
        is_own_page = not origin or origin.partition("//")[2] == netloc
        if scope["type"] == "lifespan" or (is_own_page and _is_own(netloc, names)):
            await app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await PlainTextResponse("This server has another name.", 403)(scope, receive, send)

    return guarded


def _is_own(netloc: str, names: set[str]) -> bool:
    """Return whether a Host header has a name of this server, or an address.

    An address is safe, because only a name can be bound to another server.
    """
    try:
        name = (urlsplit(f"//{netloc}").hostname or "").lower()
        return name in names or bool(ip_address(name))
    except ValueError:
        return False


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
    # A spawned process inherits neither threads nor sockets, which clones would copy.
    context = get_context("spawn")
    connection, game_connection = context.Pipe()
    process = context.Process(
        target=run_game,
        args=(game_connection, pack_plainly(make)),
    )
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
        keys = Keys(None if record is None else record.with_name(f"{record.name}.keys"))
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.create_server((host, port), family=family) as listener:
            base = f"http://{_shown_host(host)}:{listener.getsockname()[1]}"
            if state["resumed"]:
                print(f"The game of {record} goes on.", flush=True)
            print(f"Take a seat or watch at {base}/ or play at the link of a seat:", flush=True)
            table = Table(
                connection,
                state,
                lambda path: print(f"  {base}{path}", flush=True),
                keys,
                is_open=_is_loopback(host),
            )
            _run(table, host, listener, end_game)
    except EOFError:
        process.join()
        raise ProcessDiedError(
            f"the process of the game has ended, with exit code {process.exitcode}"
        ) from None
    except OSError as error:
        if isinstance(error, SimEnvError):
            raise
        raise OptionValueError(f"cannot listen on {host}, port {port}: {error}") from error
    finally:
        end_game()
    returns = json.loads(table.latest["state"])["returns"]
    return "The returns: " + ", ".join(f"{agent} {total:g}" for agent, total in returns.items())


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _shown_host(host: str) -> str:
    """Return the host of the links for an address to listen on."""
    if host in ("0.0.0.0", "::"):
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


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
        writer = asyncio.create_task(table.write_game())
        reader.add_done_callback(server.exit_soon)
        yield
        died = reader.done()
        await asyncio.to_thread(end_game)
        await reader
        writer.cancel()

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
