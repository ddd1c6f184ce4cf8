"""The paper's showcase (its supplements S1 and S2, and step 4) runs as it is printed, but for its import lines."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

PAPER = Path(__file__).parents[3] / "shared" / "paper" / "sim-env.tex"

pytestmark = pytest.mark.skipif(not PAPER.exists(), reason="the paper is not at hand")


def listing(first_line):
    """The listing that begins with that line."""
    text = PAPER.read_text(encoding="utf-8")
    start = text.index(f"\\begin{{verbatim}}\n{first_line}\n") + len("\\begin{verbatim}\n")
    return text[start : text.index("\\end{verbatim}", start)]


def replaced(text, changes):
    """The text with lines exchanged, each of which is there."""
    for old, new in changes.items():
        assert re.search(rf"^{re.escape(old)}$", text, re.MULTILINE), old
        text = re.sub(rf"^{re.escape(old)}$", new, text, flags=re.MULTILINE)
    return text


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "model.py").write_text(listing("# model.py"))
    changes = {
        "from gym import spaces": "from gymnasium import spaces",
        "from gym_fin.envs.sim_env import make_step": "from simenv_marl import make_step",
        "from gym_fin.envs.sim_interface import SimulationInterface": "from simenv_marl import SimulationInterface",
        "from gym.envs.registration import register": "from gymnasium.envs.registration import register",
        "from gym_fin.envs.sim_env import generate_env": "from simenv_marl import generate_env",
    }
    (tmp_path / "env_def.py").write_text(replaced(listing("# env_def.py"), changes))
    return tmp_path


def run(folder, code):
    # Gymnasium warns (UserWarning) of the listing's float64 bounds, and of humidity that leaves them.
    result = subprocess.run(
        [sys.executable, "-W", "error", "-W", "ignore::UserWarning", "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.splitlines()


DAY = re.compile(r"day (\d+) alive: (\d+), dead: (\d+)")


def test_step_4_the_environment_is_used(folder):
    changes = {
        "import gym": "import gymnasium as gym",
        "obs0 = env.reset()": "obs0, info = env.reset()",
        "obs1, rew1, done, info = env.step(rand_policy(obs0))": (
            "obs1, rew1, done, truncated, info = env.step(rand_policy(obs0))"
        ),
        "obs2, rew2, done, info = env.step(rand_policy(obs1))": (
            "obs2, rew2, done, truncated, info = env.step(rand_policy(obs1))"
        ),
    }
    code = replaced(listing("from random import random\nimport gym"), changes)
    check = """
import numpy as np
for obs in (obs0, obs1, obs2):
    assert obs.dtype == np.float32 and obs.shape == (4,), obs
assert type(rew1) is type(rew2) is float
assert done is False and truncated is False
assert len({id(obs) for obs in (obs0, obs1, obs2)}) == 3
"""
    printed = [DAY.fullmatch(line) for line in run(folder, code + check)]
    assert [int(day[1]) for day in printed] == [0, 1, 2]
    assert (printed[0][2], printed[0][3]) == ("200", "0")
    assert all(int(day[2]) + int(day[3]) == 200 for day in printed)


def test_with_the_rule_it_is_the_plain_model_and_the_agent_has_the_functions_name(folder):
    code = """
import random
from env_def import GreenhouseSim, env_cls
from simenv_marl import RULE, aec_env
random.seed(7)
plain = GreenhouseSim()
plain.reset()
plain.run()
print("--")
random.seed(7)
env = env_cls()
env.reset()
while not env.step(RULE)[2]:
    pass
state = lambda simulation: [(p.health, p.water) for p in simulation.greenhouse.pots]
assert state(plain) == state(env.unwrapped.simulation)
assert plain.day == env.unwrapped.simulation.day
for points in (["model.Greenhouse.choose_water_amount"], []):
    assert aec_env(GreenhouseSim, *points).possible_agents == ["choosewateramount_0"]
"""
    printed = run(folder, code)
    middle = printed.index("--")
    assert printed[:middle] == printed[middle + 1 :]
