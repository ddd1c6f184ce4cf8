"""Files of episodes that an error of the model has ended, as the command line shows them."""

import pytest

from simenv_marl import save_episode, single_env
from simenv_marl.episodes import replay_episode
from tests.worlds.models import define


@define(agent="ant_0")
def choose():
    return "rule"


class Bursts:
    """Fails after its third decision."""

    def reset(self, seed=None):
        self.log = []

    def run(self):
        for _ in range(3):
            self.log.append(choose())
        raise OSError("the pipe has burst")


def test_replay_command_shows_the_action_that_led_to_an_error(tmp_path):
    env = single_env(Bursts, [choose])
    env.reset(seed=1)
    env.step(4)
    env.step(5)
    with pytest.raises(OSError, match="burst"):
        env.step(6)
    save_episode(env, tmp_path / "a", unnamed=True)
    text = (tmp_path / "a").read_text()
    assert '"error"' in text
    shown = replay_episode(tmp_path / "a").splitlines()
    assert shown[-1] == "then: 6, and OSError: the pipe has burst"
    assert "pipe" not in replay_episode(tmp_path / "a", 1)
