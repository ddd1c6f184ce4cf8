"""The market: its model, two conditions, and four scripted clients in the seats, whose recording becomes a frame."""

import json

import pytest
from examples.market_seats.env import AGENTS, Free, Levied, env
from examples.market_seats.model import ROUNDS, Market

from simenv_marl import simulate
from simenv_marl.seats.play import replay
from simenv_marl.testing import check_simulation
from tests.worlds.models import follow_the_rule


def picture(market):
    return market.price, [(one.crates, one.gain, one.profit) for one in market.traders], market.random.getstate()


@pytest.mark.parametrize(("condition", "levy", "best"), [(Free, 0, 8), (Levied, 20, 5)])
def test_left_to_the_rule_each_condition_is_the_plain_model(condition, levy, best):
    for seed in range(3):
        plain = Market(levy, seed)
        plain.run()
        assert picture(follow_the_rule(env(condition), seed=seed).market) == picture(plain)
        assert [one.crates for one in plain.traders] == [best] * 4
    assert env(condition).possible_agents == AGENTS
    report = check_simulation(condition, episodes=2)
    assert report.ok, str(report)


def test_the_levy_leads_to_what_is_best_for_all():
    def profit(condition, crates):
        policies = dict.fromkeys(AGENTS, lambda observation: crates)
        return sum(one.profit for one in simulate(condition, policies, seed=1).market.traders)

    for condition in (Free, Levied):  # all get back what all pay
        assert max(range(11), key=lambda crates: profit(condition, crates)) == 5
        assert profit(condition, 5) == profit(Free, 5)


@pytest.mark.parametrize("condition", [Free, Levied])
def test_four_clients_play_an_episode_to_its_end_and_its_recording_becomes_a_frame(condition, tmp_path):
    pd, path = pytest.importorskip("pandas"), tmp_path / "people.jsonl"
    clients = pytest.importorskip("tests.seats.play.test_server")
    seats = ["--seat", *AGENTS, "--seed", "3", "--record", str(path)]
    server = clients.Server(*seats, simulation=f"examples.market_seats.env:{condition.__name__}")
    try:
        pages = {agent: server.page(agent) for agent in AGENTS}
        for turn in range(4 * ROUNDS):
            place = turn // 4 + turn % 4  # each round, another one decides first
            agent = AGENTS[place % 4]
            decision = pages[agent].wait_for_turn(turn)["pending"]
            assert (decision["agent"], decision["time"]) == (agent, turn // 4)
            pages[agent].send(do="act", turn=turn, action=place % 11)
        state = pages[AGENTS[0]].wait("state", lambda state: state["over"])
        for page in pages.values():
            page.socket.close()
    finally:
        code, _, err = server.end()
    assert (code, err, state["over"]) == (0, "", "terminated")
    played = replay(path, condition)
    rows = [
        {"agent": agent, "turn": turn, "crates": crates, "profit": profit}
        for agent, own in played.items()
        for turn, crates, profit in zip(own.turns, own.actions, own.rewards, strict=True)
    ]
    frame = pd.DataFrame(rows).sort_values("turn")
    written = [json.loads(line) for line in path.read_text().splitlines()][1:]
    assert frame["crates"].tolist() == [line["action"] for line in written]
    assert frame["agent"].tolist() == [line["agent"] for line in written]
    assert frame.groupby("agent")["profit"].sum().to_dict() == state["returns"] == written[-1]["returns"]
    assert not any(own.by_rule.any() for own in played.values())
    own = {agent: iter(frame.loc[frame["agent"] == agent, "crates"].tolist()) for agent in AGENTS}
    by_hand = simulate(condition, {agent: lambda _, agent=agent: next(own[agent]) for agent in AGENTS}, seed=3).market
    assert [one.profit for one in by_hand.traders] == [state["returns"][agent] for agent in AGENTS]
