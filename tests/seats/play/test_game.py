"""The game of the page: decisions, the way back, futures, limits, and recordings."""

import json
import random
import struct
import time
import zlib
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

import simenv_marl
from simenv_marl import RULE, aec_env, load_episode, make_step, save_episode, simulate
from simenv_marl.data import joint_policy
from simenv_marl.errors import InvalidActionError, OptionValueError, StoreError
from simenv_marl.seats.play import replay
from simenv_marl.seats.play.forms import (
    action_of,
    complaint_about,
    form_of,
    jsonable,
    shown,
    words_of,
)
from simenv_marl.seats.play.game import Game
from simenv_marl.seats.play.host import Host, Rules
from simenv_marl.seats.play.recording import read
from tests.planning.test_candidates import Works, points
from tests.worlds import models
from tests.worlds.seats import ORDER, BreakingShop, ClosingShop, FixedShop, Shop


@pytest.fixture(autouse=True)
def few_futures(monkeypatch):
    monkeypatch.setattr("simenv_marl.seats.play.futures.FUTURES", 4)


@pytest.fixture
def make_host():
    hosts = []

    def make(
        simulation=Shop, *, seats=("buyer",), seed=5, limit=None, tools="all", unit="", **options
    ):
        sent = []
        game = Game(simulation, name="shop", seats=seats, seed=seed, **options)
        hosts.append(Host(game, Rules("Shop", tools, limit, unit), sent.append))
        hosts[-1].sent = sent
        return hosts[-1]

    yield make
    for host in hosts:
        host.abandon()
        host.game.close()


def settle(host):
    """Let the rule decide where no person does; return what the page gets then."""
    states = []
    for update in host.work():
        states += [update] if update and update["type"] == "state" else []
        if update and update["type"] == "fan":
            break  # else futures follow
    return states[-1]


def think(host):
    """Return the last message about the futures."""
    updates = [update for update in host.work() if update]
    if host.game.can_fork:
        host.exploring.wait()
        updates += [message for _, message in host.sent]
    return updates[-1]


def play(host, actions):
    for action in actions:
        settle(host)
        host.handle(host.game.now["agent"], act(host, action))
    return settle(host)


def act(host, action):
    return {"do": "act", "turn": host.game.turn, "action": action}


class Connection:
    """Messages to come, then the end."""

    def __init__(self, *messages):
        self.messages = [*messages, (None, None, None)]

    def poll(self, timeout=0):
        return bool(self.messages)

    def recv(self):
        return self.messages.pop(0)


def as_by_hand(actions):
    """Play the same episode without the page; return its turns, and the profit."""
    env = aec_env(Shop)
    return models.play(env, {"buyer": iter(actions), "seller": RULE}, seed=5), env.simulation.profit


def test_play_game_equals_an_env_episode_and_its_end_can_be_undone(make_host):
    """The rule decides for agents without a person."""
    actions = [3, 1, 0, 2, 1, 1, 0, 2]
    host = make_host()
    state = settle(host)
    assert (state["turn"], state["pending"]["agent"], state["pending"]["question"]) == (
        0,
        "buyer",
        "By its rule: Order pieces.",
    )
    state = play(host, actions[:1])
    assert [(row["agent"], row["by"]) for row in state["history"][:2]] == [
        ("buyer", "person"),
        ("seller", "rule"),
    ]
    assert (state["turn"], state["pending"]["agent"], state["pending"]["time"]) == (2, "buyer", 1.0)
    stock = host.game.env.simulation.stock
    legal = [amount for amount in range(4) if stock + amount < 7]
    assert [card["action"] for card in state["pending"]["form"]["cards"]] == legal
    state = play(host, actions[1:])
    turns, profit = as_by_hand(actions)
    assert state["over"] == "terminated"
    assert state["returns"]["buyer"] == profit == sum(models.rewards_of(turns, "buyer"))
    assert state["returns"]["seller"] == sum(models.rewards_of(turns, "seller"))
    rewards = [row["reward"] for row in host.game.timeline if row["agent"] == "buyer"]
    assert rewards == models.rewards_of(turns, "buyer")
    host.handle("buyer", {"do": "undo"})
    assert (host.game.turn, host.game.over, host.game.now["agent"]) == (14, "", "buyer")
    assert settle(host)["seats"] == ["buyer"]
    host.handle("buyer", {"do": "redo"})
    assert (host.game.turn, host.game.over, host.game.returns) == (
        16,
        "terminated",
        state["returns"],
    )
    host.handle("buyer", {"do": "undo"})
    assert play(host, [2])["returns"] == state["returns"]


@pytest.mark.parametrize("forks", [True, False])
def test_play_game_jump_undo_and_redo_lead_to_the_same_decisions(make_host, forks, monkeypatch):
    monkeypatch.setattr("simenv_marl.seats.play.game.CHECKPOINTS", 4)
    host = make_host()
    host.game.can_fork = forks
    play(host, [1, 3, 0, 2])
    before = json.dumps(host.game.timeline)
    for turn in (4, 0, 8, 2, 6):
        host.handle("buyer", {"do": "jump", "n": turn})
        assert host.game.turn == turn
        assert settle(host)["length"] == 8
    host.abandon()
    host.abandon()
    host.game.jump(7)  # of the seller: nobody plays it
    assert host.game.turn == 6
    for do, turn in (("undo", 4), ("redo", 6), ("redo", 8), ("redo", 8)):
        host.handle("buyer", {"do": do})
        assert host.game.turn == turn
    assert json.dumps(host.game.timeline) == before
    old = host.game.env
    host.abandon()
    host.game.jump(4)
    assert old is host.game.root or not old.agents
    host.abandon()
    host.game.decide(2, "person")
    assert max(host.game.checkpoints, default=0) <= 4
    state = play(host, [2, 1, 1, 0, 2])
    assert state["returns"]["buyer"] == as_by_hand([1, 3, 2, 2, 1, 1, 0, 2])[1]
    assert len(host.game.checkpoints) == (4 if forks else 0)
    assert host.game.notice == ""


def test_play_game_reports_a_persons_agent_that_never_decides(make_host):
    class Open(Shop):
        """Its agents are known when they decide."""

        points = {Shop.order: replace(ORDER, agent=lambda shop: "buyer")}  # noqa: RUF012

    host = make_host(Open, seats=["buier"])
    while not host.game.over:
        settle(host)
    assert host.game.notice == "No decision was one of buier; buyer decided."


def test_play_game_answers_illegal_messages_and_stays_unchanged(make_host):
    host = make_host(seats=())
    settle(host)
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
    host.serve(connection)
    replies = {number: reply for number, reply in host.sent if number is not None}
    assert [reply["type"] for reply in replies.values()] == ["error"] * len(wrong)
    texts = [reply["text"] for reply in replies.values()]
    assert "4" in texts[0]
    assert "another decision" in texts[3]
    assert "buyer decides" in texts[4]
    assert "'fly'" in texts[7]
    assert len(host.game.timeline) == 1
    assert not host.game.root.agents  # it is closed in the end


def test_play_game_tries_futures_without_moving_the_game(make_host):
    host = make_host()
    settle(host)
    fan = think(host)
    assert [one["action"] for one in fan["candidates"]] == [None, 0, 1, 2, 3]
    assert {one["n"] for one in fan["candidates"]} == {4}
    assert fan["rule"] == 2
    rule, two = (one["bands"] for one in fan["candidates"] if one["action"] in (None, 2))
    assert rule == two  # the same futures for all candidates
    assert fan["measures"][0] == "your points"
    assert len(two) == len(fan["measures"]) > 1
    below, middle, above = two[0]
    assert len(middle) == 9  # from now on
    assert all(low <= mid <= high for low, mid, high in zip(below, middle, above, strict=True))
    assert above[-1] > below[-1]
    assert (host.game.turn, host.game.env.simulation.day) == (0, 0)


def test_play_game_shows_one_future_of_a_model_without_reseed(make_host):
    host = make_host(FixedShop)
    settle(host)
    fan = think(host)
    assert {one["n"] for one in fan["candidates"]} == {1}
    assert "reseed" in fan["note"]
    play(host, [2] * 8)
    assert host.game.returns["buyer"] == simulate(FixedShop, {"buyer": lambda _: 2}, seed=5).profit


def test_play_game_shows_observations_and_actions_as_json():
    assert jsonable({1: np.array([np.inf, 1.5]), "time": -np.inf}) == {
        "1": ["inf", 1.5],
        "time": "-inf",
    }
    pair = spaces.Tuple([spaces.Discrete(3), spaces.MultiDiscrete([2, 2])])
    space = spaces.Dict({"amount": spaces.Discrete(4), "pair": pair})
    action = action_of(space, {"amount": 2, "pair": [1, [0, 1]]})
    assert action in space
    assert action_of(pair, [1]) == [1]  # which the environment refuses


def test_play_game_tries_a_persons_own_legal_action_in_futures(make_host):
    host = make_host(seats=("seller",))
    settle(host)
    assert [one["action"] for one in think(host)["candidates"]] == [None]
    host.handle("seller", {"do": "try", "turn": 1, "action": [0, 2]})
    assert [(one["action"], one["n"]) for one in think(host)["candidates"]] == [
        (None, 4),
        ([0, 2], 4),
    ]
    with pytest.raises(InvalidActionError):
        host.handle("seller", {"do": "try", "turn": 1, "action": [2, 2]})
    host.handle("seller", {"do": "horizon", "n": 2})
    assert (think(host)["horizon"], think(host)["by_time"]) == (2, False)


def test_play_game_stops_its_futures_when_a_person_decides(make_host):
    host = make_host()
    connection = Connection(
        (1, "buyer", {"do": "act", "turn": 0, "action": 1}), (1, "buyer", {"do": "nothing"})
    )
    host.serve(connection)
    turns = [
        update["turn"]
        for number, update in host.sent
        if number is None and update["type"] == "state"
    ]
    assert turns[0] == 0
    assert len(host.game.timeline) > 1


def test_play_game_lets_the_models_rule_play_for_absent_people(make_host):
    host = make_host(seats=())
    settle(host)
    host.handle("buyer", {"do": "delegate", "n": 2})
    pending = settle(host)["pending"]
    options = [[each["action"] for each in field["options"]] for field in pending["form"]["fields"]]
    assert (pending["agent"], options) == ("seller", [[0, 1], [0, 1, 2]])
    host.handle("seller", {"do": "skip"})
    state = settle(host)
    assert (state["turn"], state["pending"]["agent"]) == (1, "seller")  # it is its turn
    host.abandon()
    host.game.decide([0, 0], "person")
    host.handle(None, {"taken": ["seller"]})
    host.handle("seller", {"do": "skip"})
    state = settle(host)
    assert (state["turn"], state["pending"]["agent"]) == (3, "seller")
    host.abandon()
    host.game.decide([0, 0], "person")
    assert settle(host)["pending"]["agent"] == "buyer"  # the skip ended at the seller's turn


def test_play_game_lets_the_models_rule_decide_after_the_time_limit(make_host, monkeypatch):
    host = make_host(limit=30.0)
    assert settle(host)["left"] is None  # nobody is there
    assert not host.handle(None, {"taken": ["buyer"]})  # the game stays as it is
    assert 0 < host.snapshot()["left"] <= 30
    times = iter(range(0, 10**9, 10))
    monkeypatch.setattr("simenv_marl.seats.play.host.monotonic", lambda: next(times))
    host.deadline = 0.0
    host.serve(Connection())
    late = sum(row.get("by") == "limit" for row in host.game.timeline)
    assert host.snapshot()["late"]["buyer"] == late >= 1
    assert (host.game.timeline[0]["action"], host.game.timeline[0]["by"]) == (None, "limit")


def test_play_game_can_undo_an_error_of_the_model(make_host):
    host = make_host(BreakingShop)
    assert "the till is broken" in play(host, [1, 3])["over"]
    host.handle("buyer", {"do": "undo"})
    state = play(host, [2])
    assert (state["over"], state["turn"]) == ("", 2)
    assert state["pending"]["form"]["cards"][3]["text"] == "order 3 of 3"
    assert "division" in play(host, [1])["over"]
    host.handle("buyer", {"do": "undo"})
    assert settle(host)["turn"] == 2


def test_play_game_sends_rendered_pictures_as_png(make_host):
    host = make_host()
    play(host, [1])
    data = b64decode(settle(host)["picture"]["png"])
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    assert struct.unpack("!II", data[16:24]) == (3, 2)
    begin = data.index(b"IDAT")
    length = struct.unpack("!I", data[begin - 4 : begin])[0]
    assert zlib.decompress(data[begin + 4 : begin + 4 + length]) == (b"\0" + b"\1" * 9) * 2


def test_play_recording_repeats_the_game_without_undone_decisions(make_host, tmp_path):
    host = make_host(seats=(), record=tmp_path / "game.jsonl")
    for _ in range(3):
        settle(host)
        host.abandon()
        host.game.decide(3 if host.game.now["agent"] == "buyer" else [0, 2], "person")
    host.handle("buyer", {"do": "undo"})
    for seat in ("buyer", "seller"):
        host.delegated[seat] = 100
    settle(host)
    if host.game.now and host.game.now["agent"] == "buyer":
        host.abandon()
        host.game.decide(0, "person")
    state = settle(host)
    assert state["over"]
    found = replay(tmp_path / "game.jsonl", Shop)
    assert {
        agent: float(trajectories.returns[0]) for agent, trajectories in found.items()
    } == state["returns"]
    rows = [row for row in host.game.timeline if row["agent"] == "buyer"]
    assert found["buyer"].rewards.tolist() == [row["reward"] for row in rows]
    assert found["buyer"].by_rule.tolist() == [row["action"] is None for row in rows]
    assert found["seller"].actions[0].tolist() == [0, 2]
    assert found["buyer"].observations["stock"].tolist() == [
        row["situation"][1]["number"] for row in rows
    ]
    assert found["buyer"].terminations[-1]


def test_play_recording_becomes_data_of_all_episodes(make_host, tmp_path):
    path = tmp_path / "game.jsonl"
    host = make_host(record=path)
    head = json.loads(path.read_text())
    assert (head["seed"], head["play"]) == (5, {"simulation": "shop", "seats": ["buyer"]})
    play(host, [2] * 8)
    host.abandon()
    host.game.restart(6)
    play(host, [1])
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


def test_play_recording_contains_agents_that_end_before_others(make_host, tmp_path):
    class Closing(Shop):
        def run(self):
            self.days = 2
            super().run()
            self.end_agent("seller")
            self.order()

    host = make_host(Closing, record=tmp_path / "game.jsonl")
    assert play(host, [1, 1, 1])["over"] == "terminated"
    found = replay(tmp_path / "game.jsonl", Closing)
    assert {agent: len(trajectories) for agent, trajectories in found.items()} == {
        "buyer": 3,
        "seller": 2,
    }


def test_play_game_reports_a_recording_that_cannot_be_written(make_host, tmp_path):
    host = make_host(record=tmp_path / "game.jsonl")
    (tmp_path / "game.jsonl").unlink()
    (tmp_path / "game.jsonl").mkdir()
    state = play(host, [1])
    assert "cannot be written" in state["notice"]
    assert state["turn"] == 2
    with pytest.raises(OptionValueError, match="cannot be written"):
        make_host(record=tmp_path / "missing" / "game.jsonl")


def test_play_game_history_keeps_the_labels_of_each_past_decision(make_host):
    host = make_host(BreakingShop, unit="day")
    state = play(host, [2, 1])
    words = [(row["agent"], row["words"], row["when"]) for row in state["history"]]
    assert words == [("buyer", "order 2 of 1", "day 0"), ("buyer", "order 1 of 1", "day 1")]
    host.handle("buyer", {"do": "undo"})
    state = settle(host)
    assert [row["words"] for row in state["history"]] == ["order 2 of 1"]
    assert state["event"] == "buyer went back to decision 2, day 1."
    host.handle("buyer", {"do": "redo"})
    assert [row["words"] for row in settle(host)["history"]] == ["order 2 of 1", "order 1 of 1"]


def test_play_game_shows_label_and_history_of_each_observed_component(make_host):
    many = replace(
        ORDER,
        observation_space=spaces.Box(-np.inf, np.inf, (20,)),
        observation_space_mapping=lambda shop: [shop.day + place for place in range(20)],
        observation_labels=[f"value {place}" for place in range(20)],
    )

    class Wide(Shop):
        points = {Shop.order: many}  # noqa: RUF012

    host = make_host(Wide)
    state = play(host, [1, 1])
    for place, entry in enumerate(state["views"]["buyer"]["situation"]):
        assert entry["label"] == f"value {place}"
        assert entry["past"] == [place, place + 1, place + 2]


def test_play_game_shows_display_mapping_instead_of_the_observation(make_host):
    shown = replace(
        ORDER, question="How much?", display_mapping=lambda shop: {"day": f"{shop.day} d"}
    )

    class Shown(Shop):
        points = {Shop.order: shown}  # noqa: RUF012

    host = make_host(Shown)
    pending = play(host, [1])["pending"]
    assert (pending["question"], pending["situation"]) == (
        "How much?",
        [{"label": "day", "text": "1 d", "number": 1.0}],
    )
    assert think(host)["measures"] == ["your points", "day"]


def test_play_game_futures_of_all_actions_have_the_same_duration(make_host):
    class Mill(Works):
        points = points()

    host = make_host(Mill, seats=("machine",), policies={"watchman": lambda observation: 0})
    settle(host)
    host.handle("machine", {"do": "horizon", "n": 2.5, "by": "time"})
    for candidate in think(host)["candidates"]:
        assert [row[-1] for row in candidate["bands"][0]] == pytest.approx([-2.5] * 3)


class Till:
    """Six answers, which are the rewards. Every third must not be 2. The rule answers 0."""

    def reset(self, seed=None):
        self.day, self.taken = 0, 0

    def run(self):
        for self.day in range(6):
            self.taken = self.take()

    @make_step(
        observation_space=spaces.Box(0, 6, (1,)),
        observation_space_mapping=lambda till: [till.day],
        action_space=spaces.Discrete(3),
        action_space_mapping=int,
        action_mask_mapping=lambda till: [1, 1, till.day != 2],
        reward_mapping=lambda till: till.taken,
        agent="clerk",
    )
    def take(self):
        return 0

    points = (take,)


@pytest.mark.parametrize(
    ("hold", "points"), [({}, 2), ({"hold": 2}, 4), ({"hold": 4}, 6), ({"hold": None}, 8)]
)
def test_play_game_futures_repeat_a_held_action_where_it_is_legal(make_host, hold, points):
    host = make_host(Till, seats=("clerk",))
    settle(host)
    host.handle("clerk", {"do": "horizon", "n": 5, **hold})
    fan = think(host)
    assert fan["hold"] == hold.get("hold", 1)
    candidate = next(one for one in fan["candidates"] if one["action"] == 2)
    assert [row[-1] for row in candidate["bands"][0]] == [points] * 3


@pytest.mark.parametrize("hold", [0, 101, 1.5, True, "2"])
def test_play_game_futures_refuse_an_invalid_hold(make_host, hold):
    host = make_host(Till, seats=("clerk",))
    settle(host)
    with pytest.raises(OptionValueError, match="hold must be"):
        host.handle("clerk", {"do": "horizon", "n": 5, "hold": hold})


@pytest.mark.thorough
def test_play_game_futures_use_the_models_time_and_can_be_cancelled(make_host):
    host = make_host()
    settle(host)
    fan = think(host)
    assert (fan["by_time"], fan["horizon"], fan["done"]) == (True, 8.0, True)
    host.handle("buyer", {"do": "horizon", "n": 3, "by": "time"})
    assert think(host)["horizon"] == 3

    class Slow(Shop):
        def switch(self):
            time.sleep(3)
            return super().switch()

    slow = make_host(Slow)
    settle(slow)
    time.sleep(0.5)  # its first future computes
    begin = time.monotonic()
    slow.exploring.abandon()
    assert time.monotonic() - begin < 2


def test_play_game_restart_can_be_undone(make_host, tmp_path):
    path = tmp_path / "game.jsonl"
    host = make_host(record=path)
    before = play(host, [1, 3])
    host.handle("buyer", {"do": "restart", "n": None})
    state = settle(host)
    assert (state["turn"], state["back"]) == (0, True)
    assert state["event"].startswith("buyer began another game")
    host.handle("buyer", {"do": "redo"})
    assert settle(host) | {"moment": 0, "event": ""} == before | {"moment": 0}
    play(host, [2])
    assert [len(each.decisions) for each in read(path)] == [6]


def test_play_recording_resumes_at_its_last_decision(make_host, tmp_path):
    path = tmp_path / "game.jsonl"
    host = make_host(seats=(), record=path, policies={"seller": lambda observation: [0, 1]})
    play(host, [1, 3, 2])
    host.handle("buyer", {"do": "undo"})
    before = settle(host)
    with path.open("a") as file:
        file.write('{"turn": 3, "agent": "bu')  # a crash
    again = make_host(seats=(), record=path, policies={"seller": lambda observation: [0, 1]})
    moments = {"moment": 0, "event": ""}
    assert settle(again) | moments == before | moments | {"resumed": True}
    assert {row["by"] for row in before["history"]} == {"person", "policy"}
    play(again, [0])
    assert [line["words"] for line in read(path)[-1].decisions if line["by"] == "person"] == [
        "1", "3", "0",
    ]  # fmt: skip
    assert replay(path, Shop)["seller"].actions.tolist() == [[0, 1]] * 3
    with pytest.raises(OptionValueError, match="its skip_forced is None, not True"):
        make_host(record=path, options={"skip_forced": True})
    with pytest.raises(OptionValueError, match="does not repeat"):
        make_host(BreakingShop, record=path)
    assert settle(make_host(record=path, new=True))["turn"] == 0
    assert len(read(path)) == 2


def test_play_recording_is_complete_after_a_failed_write(make_host, tmp_path, monkeypatch):
    path = tmp_path / "game.jsonl"
    host = make_host(record=path)
    path.rename(tmp_path / "kept")
    path.mkdir()
    play(host, [1])
    path.rmdir()
    (tmp_path / "kept").rename(path)
    path.write_text(path.read_text()[:-1])  # without the end of its line
    play(host, [2])
    assert [line["turn"] for line in read(path)[0].decisions] == [0, 1, 2, 3]


def test_play_game_returns_are_right_after_undo_past_an_end(make_host):
    class Closing(Shop):
        def run(self):
            self.days = 3
            super().run()
            self.end_agent("seller")
            for self.day in range(3, 6):
                self.order()

    host = make_host(Closing, seats=())
    states = []
    while not host.game.over:
        states.append(settle(host))
        action = 1 if host.game.now["agent"] == "buyer" else [1, 1]
        host.abandon()
        host.game.decide(action, "person")
    states.append(settle(host))
    turns = [*range(len(states))]
    random.Random(1).shuffle(turns)
    for turn in turns * 2:
        host.handle("buyer", {"do": "jump", "n": turn})
        state = settle(host)
        assert (state["turn"], state["returns"]) == (turn, states[turn]["returns"])


def test_play_game_policy_of_an_agent_decides_and_its_errors_are_shown(make_host):
    async def policy(observation, *, _decision):
        assert not _decision.in_clone
        return [1, 2]

    def broken(observation):
        raise KeyError("seller")

    host = make_host(seats=(), policies={"seller": policy})
    state = play(host, [1])
    assert state["policies"]["seller"].endswith("policy")
    assert [(row["agent"], row["by"], row["action"]) for row in state["history"]] == [
        ("buyer", "person", 1),
        ("seller", "policy", [1, 2]),
    ]
    host.handle("buyer", {"do": "undo"})  # in a clone, the policy is asked as in the game
    assert play(host, [2])["history"][1]["action"] == [1, 2]
    assert (
        "the policy of seller has failed"
        in play(make_host(policies={"seller": broken}), [1])["ending"]
    )
    assert "illegally" in play(make_host(policies={"seller": lambda _: [5, 5]}), [1])["ending"]


def test_play_game_accepts_joint_and_turn_policies(make_host):
    env = simenv_marl.joint_env(Shop)
    both = joint_policy(lambda observation: {"buyer": 2, "seller": [0, 1]}, like=env)
    host = make_host(seats=("buyer",), policies=both)
    history = play(host, [1, 3])["history"]
    assert [row["action"] for row in history] == [1, [0, 1], 3, [0, 1]]


def test_play_game_compares_its_end_with_the_models_rule(make_host):
    host = make_host(options={"max_steps": 6})
    state = play(host, [1, 3, 0])
    assert (state["over"], state["ending"]) == ("truncated", "Time is up.")
    compared = think(host)
    plain = make_host(options={"max_steps": 6})
    rule = play(plain, [None] * 0)
    while not plain.game.over:
        plain.game.decide(None, "rule")
    assert compared["type"] == "rule"
    assert compared["totals"]["buyer"] == plain.game.returns["buyer"]
    assert len(state["courses"]["buyer"]) == len(compared["courses"]["buyer"]) == 4
    assert rule["turn"] == 0
    host.handle("buyer", {"do": "again"})
    assert settle(host)["turn"] == 0


@pytest.mark.parametrize("finished", [False, True])
def test_play_game_resumed_compares_with_the_rule_from_the_start(make_host, tmp_path, finished):
    path = tmp_path / "game.jsonl"
    game = make_host(record=path).game
    while not game.over and (finished or len(game.timeline) < 6):
        is_person = game.plays(game.now["agent"])
        game.decide(1 if is_person else None, "person" if is_person else "rule")
    game.close()
    host = make_host(record=path)
    while not host.game.over:
        host.game.decide(None, "rule")
    compared = think(host)
    plain = make_host()
    while not plain.game.over:
        plain.game.decide(None, "rule")
    assert compared["note"] == ""
    assert compared["totals"]["buyer"] == plain.game.returns["buyer"]


def test_play_game_allows_undo_only_to_the_facilitator(make_host):
    host = make_host(tools="facilitator")
    play(host, [1])
    with pytest.raises(InvalidActionError, match="facilitator"):
        host.handle("buyer", {"do": "undo"})
    host.handle("", {"do": "undo"})
    assert settle(host)["event"] == "The facilitator went back to decision 1, time 0."
    with pytest.raises(OptionValueError, match="tools"):
        make_host(tools="nurse")


def test_play_game_ignores_a_click_for_an_earlier_state(make_host):
    host = make_host()
    state = play(host, [1, 2])
    for _ in range(2):
        host.handle("buyer", {"do": "undo", "moment": state["moment"]})
    assert settle(host)["turn"] == 2


def test_play_game_never_sends_nan_or_infinity(make_host):
    class Wild(Shop):
        points = {  # noqa: RUF012
            Shop.order: replace(
                ORDER,
                observation_space=spaces.Box(-np.inf, np.inf, (2,)),
                observation_space_mapping=lambda shop: [np.inf, np.nan],
                display_mapping=None,
            )
        }

    host = make_host(Wild)
    play(host, [1])
    host.exploring.wait()
    for message in [settle(host), *(each for _, each in host.sent)]:
        json.dumps(jsonable(message), allow_nan=False)
    assert think(host)["measures"] == ["your points"]


@pytest.mark.parametrize(
    ("space", "action", "text"),
    [
        (spaces.Box(0.0, 1.0, (1,)), [7], "Enter a number from 0 to 1, not 7."),
        (spaces.Box(0, 5, (2,), int), [2, 0.5], "Enter a whole number from 0 to 5, not 0.5."),
        (
            spaces.Box(0.0, np.inf, (1,)),
            ["Infinity"],
            "Enter a number of at least 0, not 'Infinity'.",
        ),
        (spaces.Discrete(3), 9, "Choose one of these answers: 0, 1, 2 (not 9)."),
        (spaces.MultiDiscrete([2, 2]), [0, 4], "Choose one of 0, 1, not 4."),
        (spaces.Dict({"a": spaces.Discrete(2)}), {"a": 3}, "Choose one of 0, 1, not 3."),
        (spaces.Text(3), "four", "Enter at most 3 characters, not 'four'."),
    ],
)
def test_play_game_refuses_an_action_in_the_words_of_its_form(space, action, text):
    form = form_of(space, None, None)
    assert complaint_about(form, action)["text"] == text
    legal = jsonable(space.sample())
    assert complaint_about(form, legal) == {} or "cards" in form
    assert words_of(form, legal)


def test_play_game_hides_masked_actions_and_rounds_values():
    form = form_of(spaces.Discrete(4), np.array([1, 0, 1, 0], np.int8), {0: "no", 2: "two"})
    assert form == {"cards": [{"action": 0, "text": "no"}, {"action": 2, "text": "two"}]}
    texts = [shown(value) for value in (1 / 3, 1234.56, 123456.7, 1e-7, 12, True, np.float32(0.1))]
    assert texts == ["0.3333", "1235", "123457", "1e-07", "12", "yes", "0.1"]


def test_play_recording_of_a_finished_game_resumes_at_its_end(make_host, tmp_path):
    path = tmp_path / "game.jsonl"
    over = play(make_host(record=path), [2] * 8)
    moments = {"moment": 0, "event": ""}
    again = make_host(seats=(), record=path)  # with the recorded seats
    assert settle(again) | moments == over | moments | {"resumed": True}
    again.handle("buyer", {"do": "undo"})
    assert settle(again)["turn"] == 14
    assert settle(make_host(record=path))["turn"] == 14


def places_of(env):
    """Return where an environment stands: its model, and the pending decision."""
    shop = env.unwrapped.simulation
    state = shop.day, shop.stock, shop.profit, shop.switches, shop.random.getstate()
    return state, [*env.agents], env.agents and repr(env.last())


def test_play_recording_is_an_episode_file_that_load_episode_reads(make_host, tmp_path):
    path = tmp_path / "game.jsonl"
    host = make_host(seats=(), record=path, policies={"seller": lambda observation: [0, 1]})
    host.game.restart(9)
    play(host, [1, 3, 2])
    host.handle("buyer", {"do": "undo"})
    settle(host)
    by_hand = aec_env(Shop)
    by_hand.reset(seed=9)
    for action in (1, np.array([0, 1]), 3, np.array([0, 1])):
        by_hand.step(action)
    assert places_of(load_episode(path)) == places_of(by_hand)
    host.handle("buyer", {"do": "redo"})
    by_hand.step(2)
    by_hand.step(np.array([0, 1]))
    assert places_of(load_episode(path)) == places_of(by_hand)
    play(host, [0] * 5)
    loaded = load_episode(path)
    assert (loaded.agents, loaded.episode.terminated) == ([], True)
    host.handle("buyer", {"do": "restart", "n": 3})
    settle(host)
    assert load_episode(path).session.seed == 3
    host.handle("buyer", {"do": "redo"})
    assert load_episode(path).session.seed == 9


def test_play_recording_after_an_error_is_loaded_before_the_error(make_host, tmp_path):
    host = make_host(BreakingShop, record=tmp_path / "game.jsonl")
    assert "the till is broken" in play(host, [1, 3])["over"]
    loaded = load_episode(tmp_path / "game.jsonl")
    with pytest.raises(ZeroDivisionError, match="the till is broken"):
        loaded.step(3)


def test_play_recording_contains_the_ends_of_agents(make_host, tmp_path):
    host = make_host(ClosingShop, seats=(), record=tmp_path / "game.jsonl")
    for _ in range(4):
        settle(host)
        host.abandon()
        host.game.decide(0 if host.game.now["agent"] == "buyer" else [0, 1], "person")
    loaded = load_episode(tmp_path / "game.jsonl")
    assert loaded.agents == host.game.env.agents
    assert repr(loaded.last()) == repr(host.game.env.last())


OLD = [
    (0, "buyer", 1, "person"),
    (1, "seller", [0, 1], "person"),
    (2, "buyer", 3, "person"),
    (2, None, None, None),
    (2, "buyer", None, "rule"),
]


@pytest.mark.thorough
def test_play_recording_of_an_older_version_is_resumed(make_host, tmp_path):
    path = tmp_path / "game.jsonl"
    before = make_host(seats=())
    play(before, [1])
    before.abandon()
    before.game.decide([0, 1], "person")
    lines = [{"simulation": "shop", "seed": 5, "seats": []}]
    for turn, agent, action, by in OLD:
        answer = {"action": action, "by": by, "words": "", "number": 1, "time": 0.0}
        seen = before.game.timeline[turn]["seen"]
        lines.append({"turn": turn} | (answer | {"agent": agent, "seen": seen} if agent else {}))
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    again = make_host(seats=(), record=path)
    settle(again)
    assert [(row["action"], row["by"]) for row in again.game.timeline[:3]] == [
        (1, "person"), ([0, 1], "person"), (None, "rule"),
    ]  # fmt: skip
    play(again, [[1, 1]])
    assert [len(each.decisions) for each in read(path)] == [4]
    assert replay(path, Shop)["seller"].actions.tolist() == [[0, 1], [1, 1]]
    with pytest.raises(OptionValueError, match="its max_steps is None, not 3"):
        make_host(record=path, options={"max_steps": 3})


def test_play_refuses_an_episode_file_as_its_recording(make_host, tmp_path):
    env = aec_env(Shop)
    env.reset(seed=1)
    save_episode(env, tmp_path / "episode")
    with pytest.raises(OptionValueError, match="no recording of a game"):
        make_host(record=tmp_path / "episode")
