"""The paper's showcase (supplements S1 and S2, step 4) runs as printed, except for its imports."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

PAPER = Path(__file__).parents[3] / "shared" / "paper" / "sim-env.tex"

CHANGES = {
    "from gym import spaces": "from gymnasium import spaces",
    "from gym_fin.envs.sim_env import make_step": "from simenv_marl import make_step",
    "from gym_fin.envs.sim_interface import SimulationInterface": (
        "from simenv_marl import SimulationInterface"
    ),
    "from gym.envs.registration import register": (
        "from gymnasium.envs.registration import register"
    ),
    "from gym_fin.envs.sim_env import generate_env": "from simenv_marl import generate_env",
    "import gym": "import gymnasium as gym",
    "obs0 = env.reset()": "obs0, info = env.reset()",
    "obs1, rew1, done, info = env.step(rand_policy(obs0))": (
        "obs1, rew1, done, truncated, info = env.step(rand_policy(obs0))"
    ),
    "obs2, rew2, done, info = env.step(rand_policy(obs1))": (
        "obs2, rew2, done, truncated, info = env.step(rand_policy(obs1))"
    ),
}

CHECKS = """
import numpy as np
for obs in (obs0, obs1, obs2):
    assert obs.dtype == np.float32 and obs.shape == (4,), obs
assert type(rew1) is type(rew2) is float
assert done is False and truncated is False
assert len({id(obs) for obs in (obs0, obs1, obs2)}) == 3
print("--")

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
assert state(plain) == state(env.simulation)
assert plain.day == env.simulation.day
for points in (["model.Greenhouse.choose_water_amount"], []):
    assert aec_env(GreenhouseSim, *points).possible_agents == ["choosewateramount_0"]
"""
"""With the rule it is the plain model, and the agent has the function's name."""


@pytest.mark.skipif(not PAPER.exists(), reason="the paper is not at hand")
def test_paper_showcase_with_rule_actions_runs_like_the_model_without_env(tmp_path):
    text = PAPER.read_text(encoding="utf-8")
    for old, new in CHANGES.items():
        text, times = re.subn(rf"^{re.escape(old)}$", new, text, flags=re.MULTILINE)
        assert times, old

    def listing(first_line):
        start = text.index(f"\\begin{{verbatim}}\n{first_line}\n") + len("\\begin{verbatim}\n")
        return text[start : text.index("\\end{verbatim}", start)]

    (tmp_path / "model.py").write_text(listing("# model.py"))
    (tmp_path / "env_def.py").write_text(listing("# env_def.py"))
    code = listing("from random import random\nimport gymnasium as gym") + CHECKS
    # Gymnasium warns (UserWarning) of the listing's float64 bounds, and of humidity that leaves
    # them.
    command = [sys.executable, "-W", "error", "-W", "ignore::UserWarning", "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    used, plain, ruled = (part.splitlines() for part in done.stdout.split("--\n"))
    assert plain == ruled
    days = [re.fullmatch(r"day (\d+) alive: (\d+), dead: (\d+)", line).groups() for line in used]
    assert [day for day, *_ in days] == ["0", "1", "2"]
    assert days[0][1:] == ("200", "0")
    assert all(int(alive) + int(dead) == 200 for _, alive, dead in days)
