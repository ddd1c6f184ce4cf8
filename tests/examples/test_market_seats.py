"""The market and its two conditions; the page on people plays it, and reads a recording."""

from examples.market_seats.env import AGENTS, Free, Levied

from simenv_marl import simulate


def test_market_levy_leads_the_models_rule_to_the_best_joint_profit():
    def traders(condition, policies):
        return simulate(condition, policies, seed=1).market.traders

    def profit(condition, crates):
        return sum(
            one.profit
            for one in traders(condition, dict.fromkeys(AGENTS, lambda observation: crates))
        )

    for condition, by_rule in ((Free, 8), (Levied, 5)):  # all get back what all pay
        assert max(range(11), key=lambda crates: profit(condition, crates)) == 5
        assert profit(condition, 5) == profit(Free, 5)
        assert [one.crates for one in traders(condition, {})] == [by_rule] * 4
