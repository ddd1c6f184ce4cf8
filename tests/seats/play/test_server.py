"""The command and its server: links, keys, hosts, limits of messages and connections, the end."""

import asyncio
import json
import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from unittest.mock import AsyncMock
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest

from simenv_marl import parallel_env, save_episode
from simenv_marl.__main__ import main
from tests.processes import ROOT, gone

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
client = pytest.importorskip("websockets.sync.client")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from simenv_marl.core import pack_plainly, unpack  # noqa: E402
from simenv_marl.errors import OptionValueError  # noqa: E402
from simenv_marl.seats.play import play  # noqa: E402
from simenv_marl.seats.play.host import Rules  # noqa: E402
from simenv_marl.seats.play.server import Table  # noqa: E402
from simenv_marl.seats.play.start import find_game  # noqa: E402
from tests.worlds.seats import Shop, five  # noqa: E402

SHOP = "tests.worlds.seats:Shop"


class Server:
    """The command, and the links that it prints."""

    def __init__(self, *arguments, simulation=SHOP, command="play"):
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])}
        command = [
            sys.executable,
            "-m",
            "simenv_marl",
            command,
            simulation,
            *(() if "--port" in arguments else ("--port", "0")),
            *arguments,
        ]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env=environment, cwd=ROOT, start_new_session=True,
        )  # fmt: skip
        line = self.process.stdout.readline()
        self.resumed = "goes on" in line
        if self.resumed:
            line = self.process.stdout.readline()
        self.base = re.search(r"http://\S+", line)[0]
        self.host = self.base.split("/")[2]
        self.links, self.facilitator = {}, ""

    def keys(self, *seats):
        while not self.links.keys() >= set(seats):
            link = self.process.stdout.readline().strip()
            if "/facilitator" in link:
                self.facilitator = link.removeprefix(self.base)
            else:
                seat, key = re.search(r"/seat/(\S+)\?key=(\w+)$", link).groups()
                self.links[seat] = key
        return [self.links[seat] for seat in seats]

    def page(self, seat="", key="", **options):
        return Page(self, seat, key or (self.keys(seat)[0] if seat else ""), options)

    def children(self):
        path = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return [int(number) for number in path.read_text().split()]

    def end(self):
        os.killpg(self.process.pid, signal.SIGINT)  # as Ctrl-C does
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err


class Page:
    """A page without a browser."""

    def __init__(self, server, seat, key, options):
        self.seat, self.key = seat, key
        settings = {"open_timeout": 60, "close_timeout": 1, "max_queue": None, **options}
        self.socket = client.connect(f"ws://{server.host}/ws", **settings).__enter__()
        if seat:
            self.send(do="take")

    def send(self, **message):
        self.socket.send(json.dumps({"seat": self.seat, "key": self.key, **message}))

    def wait(self, kind, condition=lambda message: True):
        while True:
            message = json.loads(self.socket.recv(timeout=60))
            if message["type"] == kind and condition(message):
                return message

    def wait_for_the_end(self):
        """Wait until the server closes the connection; return its code."""
        with pytest.raises(ConnectionClosed) as closed:
            self.wait("nothing")
        return closed.value.rcvd.code

    def wait_for_turn(self, turn):
        return self.wait("state", lambda state: state["turn"] == turn)


@pytest.fixture(scope="module")
def server():
    server = Server("--seed", "5")
    yield server
    assert server.end()[0] == 0


@pytest.fixture
def page(server):
    """Make pages that are closed in the end."""
    pages = []

    def make(*arguments, **options):
        pages.append(server.page(*arguments, **options))
        return pages[-1]

    yield make
    for one in pages:
        one.socket.close()


@pytest.fixture
def buyer(page):
    buyer = page("buyer")
    buyer.send(do="restart", n=5)
    buyer.wait_for_turn(0)
    return buyer


def test_play_server_shows_a_spectator_the_game_of_two_people():
    server = Server("--seed", "5")  # which nobody else has used
    buyer, seller, spectator = server.page("buyer"), server.page("seller"), server.page()
    everybody = {"buyer": 1, "seller": 1}
    people = spectator.wait("people", lambda people: people["taken"] == everybody)
    assert (people["spectators"], sorted(people["opened"])) == (1, ["buyer", "seller"])
    buyer.send(do="act", turn=0, action=2)
    assert seller.wait_for_turn(1)["pending"]["agent"] == "seller"
    seller.send(do="act", turn=1, action=[1, 1])
    buyer.wait_for_turn(2)
    state = spectator.wait_for_turn(2)
    assert [(row["agent"], row["action"]) for row in state["history"][:2]] == [
        ("buyer", 2),
        ("seller", [1, 1]),
    ]
    fan = buyer.wait("fan", lambda fan: fan["turn"] == 2 and fan["candidates"][-1]["n"] > 1)
    assert fan["candidates"][0]["action"] is None
    again = server.page("buyer")  # as after a reload
    assert again.wait("state")["turn"] == 2
    for one in (buyer, seller, spectator, again):
        one.socket.close()
    assert server.end()[0] == 0


def test_play_server_ignores_messages_without_the_agents_key(server, page, buyer):
    (key,) = server.keys("seller")
    for stranger in (
        page("buyer", key),
        page("buyer", "0" * 32),
        page("nobody", key),
        page("", ""),
    ):
        stranger.send(do="act", turn=0, action=1)
        assert "key" in stranger.wait("error")["text"]
    for text in (
        "{",
        "[]",
        "[" * 60_000,
        "1",
        '{"seat": "buyer"}',
        json.dumps({"seat": "büyer", "key": "\ud800"}),
    ):
        stranger.socket.send(text)
        assert stranger.wait("error")
    stranger.socket.send(b"\xff\xfe")
    assert stranger.wait("error")
    stranger.socket.send("x" * 100_000)  # which is too long, and ends its connection alone
    stranger.wait_for_the_end()
    assert page().wait("state")["turn"] == 0


def test_play_server_answers_an_illegal_action_with_a_text(buyer):
    buyer.send(do="act", turn=0, action=17)
    assert "17" in buyer.wait("error")["text"]
    for action in (
        "<b>",
        float("nan"),
        [[1]],
        {"a": 1},
        1e400,
        10**400,
        json.loads("[" * 300 + "]" * 300),
    ):
        buyer.send(do="act", turn=0, action=action)
        assert buyer.wait("error")["text"]
    buyer.socket.send(
        json.dumps({"seat": "buyer", "key": buyer.key, "action": "deep"}).replace(
            '"deep"', "[" * 800 + "]" * 800
        )
    )
    assert buyer.wait("error")["text"]
    buyer.send(do="act", turn=0, action=1)
    buyer.wait_for_turn(1)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:80", "Origin": "http://evil.example:80"},
        {"Host": "[::1"},
    ],
)
def test_play_server_refuses_requests_for_another_host(server, headers):
    with pytest.raises(HTTPError, match="403") as caught:
        urlopen(Request(server.base, headers=headers), timeout=60)
    caught.value.close()


def test_play_server_refuses_other_origins_and_serves_all_its_pages(server):
    with pytest.raises(InvalidStatus):
        server.page(additional_headers={"Origin": "http://evil.example"})
    for path in ("", "seat/buyer?key=x", "page.js", "page.css"):
        with urlopen(f"{server.base}{path}", timeout=60) as answer:
            text = answer.read().decode()
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text)


@pytest.mark.thorough
def test_play_server_serves_others_while_one_page_floods_it(page, buyer):
    flood = page("seller")
    flood.socket.socket.settimeout(0.2)
    with suppress(TimeoutError, ConnectionClosed):  # nobody reads so fast
        for _ in range(200_000):
            flood.send(do="horizon", n=1000, more="x" * 1000)
    buyer.send(do="act", turn=0, action=1)
    buyer.wait_for_turn(1)


def test_play_server_with_many_connections_drops_old_spectators_first(server, page, buyer):
    idle = [socket.create_connection(server.host.split(":"), timeout=60) for _ in range(60)]
    spectators = [page() for _ in range(70)]
    assert spectators[0].wait_for_the_end() == 1013  # try again later
    for one in idle:
        one.close()
    buyer.send(do="act", turn=0, action=1)
    buyer.wait_for_turn(1)


def test_play_server_keeps_no_task_of_a_closed_page():
    async def visit():
        table = Table(None, {"type": "state"}, print)
        await table.serve(page)
        await asyncio.sleep(0)
        assert not table.links
        assert asyncio.all_tasks() == {asyncio.current_task()}

    page = AsyncMock()
    page.receive.return_value = {"type": "websocket.disconnect"}
    asyncio.run(visit())


@pytest.mark.thorough
def test_play_server_kills_a_game_that_does_not_end():
    server = Server("--seat", "buyer", simulation="tests.worlds.seats:EndlessShop")
    server.page("buyer").wait("state")
    assert server.end()[0] == 0


@pytest.mark.thorough
def test_play_server_leaves_no_process_when_it_ends(tmp_path):
    arguments = "--seat", "buyer", "--record", str(tmp_path / "game.jsonl")
    server = Server(*arguments, simulation="tests.worlds.seats:ClosedShop")
    buyer = server.page("buyer")
    buyer.wait("fan")
    children = server.children()
    assert children
    code, out, err = server.end()
    assert (code, err) == (0, "")
    assert out.startswith("It is closed.\nThe returns: buyer")
    buyer.wait_for_the_end()
    assert all(map(gone, children))
    assert (tmp_path / "game.jsonl").read_text().count("\n") == 1


@pytest.mark.thorough
def test_play_server_ends_with_its_game():
    server = Server()
    (game,) = [
        child
        for child in server.children()
        if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text()
    ]
    os.kill(game, signal.SIGKILL)
    _, err = server.process.communicate(timeout=60)
    assert server.process.returncode == 2
    assert "exit code -9" in err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([SHOP, "--seat", "buier"], "did you mean buyer"),
        ([SHOP, "--limit", "nan"], "limit"),
        ([SHOP, "--port", "99999"], "port 99999"),
        ([SHOP, "--host", "192.0.2.1"], "192.0.2.1"),
        (["tests.worlds.seats:Shopp"], "did you mean"),
        (["tests.worlds.seats:BrokenShop"], "the door is locked"),
        (["tests.worlds.seats:LeavingShop"], "has ended, with exit code 3"),
    ],
)
def test_play_command_reports_arguments_that_cannot_be_played(arguments, told, capsys):
    before = set(multiprocessing.active_children())  # joblib keeps its own for the next time
    assert main(["play", *arguments]) == 2
    assert told in capsys.readouterr().err
    assert set(multiprocessing.active_children()) <= before


def test_play_function_takes_the_arguments_of_simulate(monkeypatch, tmp_path):
    made = []

    def serve(make, **options):
        game, rules = unpack(pack_plainly(make))()  # as in the process of the game
        made.append((game.seats, game.policies.keys(), game.options, rules.title, options))
        game.close()
        return "The returns: none"

    monkeypatch.setattr("simenv_marl.seats.play.server.serve", serve)
    record = tmp_path / "game.jsonl"
    told = play(Shop, {"seller": five}, seats=["buyer"], max_steps=5, record=record, port=0)
    assert told == "The returns: none"
    assert made == [
        (
            ["buyer"],
            {"seller"},
            {"max_steps": 5},
            "Shop",
            {"host": "127.0.0.1", "port": 0, "record": record},
        )
    ]


def test_play_command_lets_policies_play_other_agents():
    found = {"shop": Shop, "five": five, "both": {"seller": five}}
    options = {"rules": Rules(""), "seed": 1, "name": "", "seats": ()}
    for text in ("seller=five", "both"):
        game, _ = find_game(found.get, "shop", [text], **options)
        assert game.agents == {"buyer": "", "seller": "five"}
        game.close()
    with pytest.raises(OptionValueError, match="AGENT=five"):
        find_game(found.get, "shop", ["five"], **options)


@pytest.mark.thorough
def test_play_server_gives_a_resumed_game_the_same_links(tmp_path):
    arguments = "--seed", "5", "--record", str(tmp_path / "game.jsonl")
    server = Server(*arguments)
    buyer = server.page("buyer")
    buyer.send(do="act", turn=0, action=2)
    buyer.wait_for_turn(1)
    keys = server.keys("buyer", "seller")
    os.killpg(server.process.pid, signal.SIGKILL)
    server.process.communicate()
    server = Server(*arguments)
    assert (server.resumed, server.keys("buyer", "seller")) == (True, keys)
    assert server.page("buyer").wait("state")["history"][0]["action"] == 2
    assert server.end()[0] == 0
    assert (tmp_path / "game.jsonl.keys").stat().st_mode & 0o077 == 0


@pytest.mark.thorough
def test_play_command_opens_an_episode_file_at_a_decision(tmp_path):
    env = parallel_env(Shop)
    env.reset(seed=5)
    for amount in (2, 1, 0):
        env.step({"buyer": amount, "seller": np.array([0, 1])})
    save_episode(env, tmp_path / "saved")
    for until, actions in ((None, [2, 1, 0]), (2, [2, 1])):
        options = () if until is None else ("--until", str(until))
        server = Server("--play", *options, simulation=str(tmp_path / "saved"), command="replay")
        buyer = server.page("buyer")
        state = buyer.wait_for_turn(2 * len(actions))
        assert [row["action"] for row in state["history"][::2]] == actions
        buyer.send(do="act", turn=2 * len(actions), action=1)
        assert buyer.wait_for_turn(2 * len(actions) + 1)["history"][-1]["by"] == "person"
        buyer.socket.close()
        assert server.end()[0] == 0
    (tmp_path / "saved").write_text("{}")
    assert main(["replay", str(tmp_path / "saved"), "--play", "--port", "0"]) == 2


def test_play_lobby_gives_a_player_a_free_agent(page):
    lobby = page()
    lobby.send(do="claim", key="")
    lobby.wait("error")
    # The page of an earlier test may not have left the seat yet.
    page().wait("people", lambda people: "seller" not in people["taken"])
    lobby.socket.send(json.dumps({"do": "claim", "seat": "seller"}))
    path = lobby.wait("link")["path"]
    seller = page("seller", path.partition("key=")[2])
    assert seller.wait("you")["seat"] == "seller"
    lobby.socket.send(json.dumps({"do": "claim", "seat": "seller"}))
    assert "link of this seat" in lobby.wait("error")["text"]


@pytest.mark.thorough
def test_play_lobby_never_gives_the_facilitators_link():
    server = Server("--tools", "facilitator")
    lobby = server.page()
    lobby.socket.send(json.dumps({"do": "claim", "seat": ""}))
    assert "not one of this page" in lobby.wait("error")["text"]
    lobby.socket.close()
    assert server.end()[0] == 0


def test_play_server_never_sends_a_too_large_number_as_infinity(buyer):
    buyer.socket.send(
        json.dumps({"key": buyer.key, "do": "act", "turn": 0, "action": 0}).replace(
            ": 0}", ": 1e999}"
        )
    )
    assert "1e999" in buyer.wait("error")["text"]


def test_play_command_names_a_missing_extra(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert main(["play", SHOP]) == 2
    assert "play needs uvicorn: install simenv-marl[play]" in capsys.readouterr().err


def test_command_line_imports_the_play_server_only_to_play():
    names = ("starlette", "uvicorn", "websockets")
    code = (
        "import simenv_marl.__main__, sys; "
        f"print([name for name in {names} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT / "src"
    )
    assert done.stdout.strip() == "[]"
