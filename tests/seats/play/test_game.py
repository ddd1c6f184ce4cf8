"""The game of the page: decisions, the way back, futures, limits, and recordings."""

import json
import struct
import zlib
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, simulate
from simenv_marl.errors import InvalidActionError, OptionValueError, StoreError
from simenv_marl.seats.play import replay
from simenv_marl.seats.play.forms import action_of, jsonable
from simenv_marl.seats.play.game import Game
from tests.seats.play.worlds import ORDER, BreakingShop, FixedShop, Shop
from tests.worlds import models


@pytest.fixture
def make_game():
    games = []

    def make(simulation=Shop, *, seats=("buyer",), seed=5, limit=None, record=None):
        game = Game(simulation, name="shop", seats=seats, seed=seed, limit=limit, record=record)
        games.append(game)
        return game

    yield make
    for game in games:
        game.forget(-1)
        game.env.close()
        game.root.close()


def settle(game):
    """Let the rule decide where no person does; return what the page gets then."""
    states = []
    for update in game.work():
        states += [update] if update else []
        if game.now is not None and update and update["type"] == "state" and game.futures:
            break
    return states[-1]


def think(game):
    """Return the last message about the futures."""
    return [update for update in game.work() if update][-1]


def play(game, actions):
    for action in actions:
        settle(game)
        game.decide(action, "person")
    return settle(game)


class Connection:
    """Messages to come, then the end."""

    def __init__(self, *messages):
        self.messages, self.sent = [*messages, (None, None, None)], []

    def poll(self, timeout=0):
        return bool(self.messages)

    def recv(self):
        return self.messages.pop(0)

    def send(self, message):
        self.sent.append(message)


def as_by_hand(actions):
    """Play the same episode without the page; return its turns, and the profit."""
    env = aec_env(Shop)
    return models.play(env, {"buyer": iter(actions), "seller": RULE}, seed=5), env.simulation.profit


def test_an_episode_is_that_of_the_environment_and_its_end_can_be_undone(make_game):
    """The rule decides for agents without a person."""
    actions = [3, 1, 0, 2, 1, 1, 0, 2]
    game = make_game()
    state = settle(game)
    assert (state["turn"], state["pending"]["agent"], state["pending"]["doc"]) == (
        0,
        "buyer",
        "Order pieces.",
    )
    state = play(game, actions[:1])
    assert [(row["agent"], row["by"]) for row in state["history"][:2]] == [
        ("buyer", "person"),
        ("seller", "rule"),
    ]
    assert (state["turn"], state["pending"]["agent"], state["pending"]["time"]) == (2, "buyer", 1.0)
    assert state["pending"]["mask"] == [
        int(game.env.simulation.stock + amount < 7) for amount in range(4)
    ]
    state = play(game, actions[1:])
    turns, profit = as_by_hand(actions)
    assert state["over"] == "terminated"
    assert state["returns"]["buyer"] == profit == sum(models.rewards_of(turns, "buyer"))
    assert state["returns"]["seller"] == sum(models.rewards_of(turns, "seller"))
    rewards = [row["reward"] for row in game.timeline if row["agent"] == "buyer"]
    assert rewards == models.rewards_of(turns, "buyer")
    game.handle("buyer", {"do": "undo"})
    assert (game.turn, game.over, game.now["agent"]) == (14, "", "buyer")
    assert settle(game)["seats"] == ["buyer"]
    game.handle("buyer", {"do": "redo"})
    assert (game.turn, game.over, game.returns) == (16, "terminated", state["returns"])
    game.handle("buyer", {"do": "undo"})
    assert play(game, [2])["returns"] == state["returns"]


@pytest.mark.parametrize("forks", [True, False])
def test_the_way_back_and_forth_leads_to_the_same_decisions(make_game, forks, monkeypatch):
    monkeypatch.setattr("simenv_marl.seats.play.game.CHECKPOINTS", 4)
    game = make_game()
    game.can_fork = forks
    play(game, [1, 3, 0, 2])
    before = json.dumps(game.timeline)
    for turn in (4, 0, 8, 2, 6):
        game.handle("buyer", {"do": "jump", "n": turn})
        assert game.turn == turn
        assert settle(game)["length"] == 8
    game.jump(7)  # of the seller: nobody plays it
    assert game.turn == 6
    for do, turn in (("undo", 4), ("redo", 6), ("redo", 8), ("redo", 8)):
        game.handle("buyer", {"do": do})
        assert game.turn == turn
    assert json.dumps(game.timeline) == before
    old = game.env
    game.jump(4)
    assert old is game.root or not old.agents
    game.decide(2, "person")
    assert max(game.checkpoints, default=0) <= 4
    state = play(game, [2, 1, 1, 0, 2])
    assert state["returns"]["buyer"] == as_by_hand([1, 3, 2, 2, 1, 1, 0, 2])[1]
    assert len(game.checkpoints) == (4 if forks else 0)
    assert game.notice == ""


def test_a_seat_whose_agent_never_decides_is_told_at_the_end(make_game):
    class Open(Shop):
        """Its agents are known when they decide."""

        points = {Shop.order: replace(ORDER, agent=lambda shop: "buyer")}  # noqa: RUF012

    game = make_game(Open, seats=["buier"])
    while not game.over:
        settle(game)
    assert game.notice == "No decision was one of buier; buyer decided."


def test_illegal_and_untimely_messages_are_answered_with_text_and_move_nothing(make_game):
    game = make_game(seats=())
    settle(game)
    wrong = [
        ("buyer", {"do": "act", "turn": 0, "action": 4}),
        ("buyer", {"do": "act", "turn": 0, "action": [1]}),
        ("buyer", {"do": "act", "turn": 0}),
        ("buyer", {"do": "act", "turn": 1, "action": 1}),
        ("seller", {"do": "act", "turn": 0, "action": [1, 1]}),
        ("buyer", {"do": "delegate", "n": "all"}),
        ("buyer", {"do": "restart", "n": -1}),
        ("buyer", {"do": "fly"}),
        ("buyer", {}),
    ]
    connection = Connection(*((number, *each) for number, each in enumerate(wrong)))
    game.serve(connection)
    replies = {number: reply for number, reply in connection.sent if number is not None}
    assert [reply["type"] for reply in replies.values()] == ["error"] * len(wrong)
    texts = [reply["text"] for reply in replies.values()]
    assert "4" in texts[0]
    assert "another decision" in texts[3]
    assert "buyer decides" in texts[4]
    assert "'fly'" in texts[7]
    assert len(game.timeline) == 1
    assert not game.root.agents  # it is closed in the end


def test_futures_are_tried_out_without_moving_the_game(make_game):
    game = make_game()
    settle(game)
    fan = think(game)
    assert [one["action"] for one in fan["candidates"]] == [None, 0, 1, 2, 3]
    assert {one["n"] for one in fan["candidates"]} == {16}
    assert fan["rule"] == 2
    rule, two = (one["bands"] for one in fan["candidates"] if one["action"] in (None, 2))
    assert rule == two  # the same futures for all candidates
    assert fan["measures"][0] == "return"
    assert len(two) == len(fan["measures"]) > 1
    below, middle, above = two[0]
    assert len(middle) == 8
    assert all(low <= mid <= high for low, mid, high in zip(below, middle, above, strict=True))
    assert above[0] > below[0]
    assert (game.turn, game.env.simulation.day) == (0, 0)


def test_without_reseed_there_is_one_future_and_a_note(make_game):
    game = make_game(FixedShop)
    settle(game)
    fan = think(game)
    assert {one["n"] for one in fan["candidates"]} == {1}
    assert "reseed" in fan["note"]
    play(game, [2] * 8)
    assert game.returns["buyer"] == simulate(FixedShop, {"buyer": lambda _: 2}, seed=5).profit


def test_observations_and_actions_have_a_form_in_json():
    assert jsonable({1: np.array([np.inf, 1.5]), "time": -np.inf}) == {
        "1": ["inf", 1.5],
        "time": "-inf",
    }
    pair = spaces.Tuple([spaces.Discrete(3), spaces.MultiDiscrete([2, 2])])
    space = spaces.Dict({"amount": spaces.Discrete(4), "pair": pair})
    action = action_of(space, {"amount": 2, "pair": [1, [0, 1]]})
    assert action in space
    assert action_of(pair, [1]) == [1]  # which the environment refuses


def test_an_action_of_the_person_becomes_a_candidate_if_it_is_legal(make_game):
    game = make_game(seats=("seller",))
    settle(game)
    assert [one["action"] for one in think(game)["candidates"]] == [None]
    game.handle("seller", {"do": "try", "turn": 1, "action": [0, 2]})
    assert [(one["action"], one["n"]) for one in think(game)["candidates"]] == [
        (None, 16),
        ([0, 2], 16),
    ]
    with pytest.raises(InvalidActionError):
        game.handle("seller", {"do": "try", "turn": 1, "action": [2, 2]})
    game.handle("seller", {"do": "horizon", "n": 2})
    assert len(think(game)["candidates"][0]["bands"][0][1]) == 2


def test_a_decision_ends_the_thinking(make_game):
    game = make_game()
    connection = Connection(
        (1, "buyer", {"do": "act", "turn": 0, "action": 1}), (1, "buyer", {"do": "nothing"})
    )
    game.serve(connection)
    turns = [
        update["turn"]
        for number, update in connection.sent
        if number is None and update["type"] == "state"
    ]
    assert turns[0] == 0
    assert len(game.timeline) > 1


def test_the_rule_plays_on_for_a_seat_and_for_seats_that_nobody_has(make_game):
    game = make_game(seats=())
    settle(game)
    game.handle("buyer", {"do": "delegate", "n": 2})
    pending = settle(game)["pending"]
    assert (pending["agent"], pending["space"]) == (
        "seller",
        {"kind": "grid", "sizes": [2, 3], "starts": [0, 0]},
    )
    game.handle("seller", {"do": "skip"})
    state = settle(game)
    assert (state["turn"], state["pending"]["agent"]) == (1, "seller")  # it is its turn
    game.decide([0, 0], "person")
    game.handle(None, {"taken": ["seller"]})
    game.handle("seller", {"do": "skip"})
    state = settle(game)
    assert (state["turn"], state["pending"]["agent"]) == (3, "seller")
    game.decide([0, 0], "person")
    assert settle(game)["pending"]["agent"] == "buyer"  # the skip ended at the seller's turn


def test_after_the_limit_the_rule_decides_and_is_counted(make_game, monkeypatch):
    game = make_game(limit=30.0)
    assert settle(game)["left"] is None  # nobody is there
    assert not game.handle(None, {"taken": ["buyer"]})  # the game stays as it is
    assert 0 < game.snapshot()["left"] <= 30
    times = iter(range(0, 10**9, 10))
    monkeypatch.setattr("simenv_marl.seats.play.game.monotonic", lambda: next(times))
    game.deadline = 0.0
    game.serve(Connection())
    late = sum(row.get("by") == "limit" for row in game.timeline)
    assert game.snapshot()["late"]["buyer"] == late >= 1
    assert (game.timeline[0]["action"], game.timeline[0]["by"]) == (None, "limit")


def test_errors_of_the_model_and_of_labels_end_the_episode_and_can_be_undone(make_game):
    game = make_game(BreakingShop)
    assert "the till is broken" in play(game, [1, 3])["over"]
    game.handle("buyer", {"do": "undo"})
    state = play(game, [2])
    assert (state["over"], state["turn"], state["pending"]["labels"]["3"]) == (
        "",
        2,
        "order 3 of 3",
    )
    assert "division" in play(game, [1])["over"]
    game.handle("buyer", {"do": "undo"})
    assert settle(game)["turn"] == 2


def test_pictures_are_sent_as_png(make_game):
    game = make_game()
    play(game, [1])
    data = b64decode(settle(game)["picture"]["png"])
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert struct.unpack("!II", data[16:24]) == (3, 2)
    begin = data.index(b"IDAT")
    length = struct.unpack("!I", data[begin - 4 : begin])[0]
    assert zlib.decompress(data[begin + 4 : begin + 4 + length]) == (b"\0" + b"\1" * 9) * 2


def test_a_recording_is_replayed_bit_for_bit_without_what_was_undone(make_game, tmp_path):
    game = make_game(seats=(), record=tmp_path / "game.jsonl")
    for _ in range(3):
        settle(game)
        game.decide(3 if game.now["agent"] == "buyer" else [0, 2], "person")
    game.handle("buyer", {"do": "undo"})
    for seat in ("buyer", "seller"):
        game.delegated[seat] = 100
    settle(game)
    game.decide(0, "person") if game.now and game.now["agent"] == "buyer" else None
    state = settle(game)
    assert state["over"]
    found = replay(tmp_path / "game.jsonl", Shop)
    assert {
        agent: float(trajectories.returns[0]) for agent, trajectories in found.items()
    } == state["returns"]
    rows = [row for row in game.timeline if row["agent"] == "buyer"]
    assert found["buyer"].rewards.tolist() == [row["reward"] for row in rows]
    assert found["buyer"].by_rule.tolist() == [row["action"] is None for row in rows]
    assert found["seller"].actions[0].tolist() == [0, 2]
    assert found["buyer"].observations["stock"].tolist() == [row["values"][1] for row in rows]
    assert found["buyer"].terminations[-1]


def test_a_recording_has_all_episodes_and_an_unfinished_one_is_truncated(make_game, tmp_path):
    path = tmp_path / "game.jsonl"
    game = make_game(record=path)
    assert json.loads(path.read_text()) == {"simulation": "shop", "seed": 5, "seats": ["buyer"]}
    play(game, [2] * 8)
    game.restart(6)
    play(game, [1])
    assert replay(path, Shop)["buyer"].seeds == (6,)
    assert replay(path, Shop)["buyer"].truncations.tolist() == [True]
    assert len(replay(path, Shop, episode=0)["buyer"]) == 8
    with pytest.raises(OptionValueError, match="episode 2"):
        replay(path, Shop, episode=2)
    with pytest.raises(OptionValueError, match="does not repeat"):
        replay(path, BreakingShop, episode=0)
    seen = json.loads(path.read_text().splitlines()[-1])["seen"]
    path.write_text(path.read_text().replace(seen, "another"))
    with pytest.raises(OptionValueError, match="or with another observation"):
        replay(path, Shop)
    path.write_text("{")
    with pytest.raises(StoreError, match="cannot be read"):
        replay(path, Shop)


def test_a_recording_has_agents_that_end_before_others(make_game, tmp_path):
    class Closing(Shop):
        def run(self):
            self.days = 2
            super().run()
            self.end_agent("seller")
            self.order()

    game = make_game(Closing, record=tmp_path / "game.jsonl")
    assert play(game, [1, 1, 1])["over"] == "terminated"
    found = replay(tmp_path / "game.jsonl", Closing)
    assert {agent: len(trajectories) for agent, trajectories in found.items()} == {
        "buyer": 3,
        "seller": 2,
    }


def test_a_recording_that_cannot_be_written_is_told_and_the_game_goes_on(make_game, tmp_path):
    game = make_game(record=tmp_path / "game.jsonl")
    (tmp_path / "game.jsonl").unlink()
    (tmp_path / "game.jsonl").mkdir()
    state = play(game, [1])
    assert "cannot be written" in state["notice"]
    assert state["turn"] == 2
    with pytest.raises(OptionValueError, match="cannot be written"):
        make_game(record=tmp_path / "missing" / "game.jsonl")
