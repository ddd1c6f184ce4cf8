"""The pages that a newcomer meets first: their code runs, and what they quote is what the library says."""

import builtins
import random
import re
import sys
from pathlib import Path

from examples.greenhouse_coop import model

import simenv_marl

from .clients import page

SOURCES = Path(simenv_marl.__file__).parent


def run(code):
    """Run code. Returns its names."""
    names = {}
    exec(code, names)
    return names


def test_the_code_of_the_front_page_has_the_rewards_that_it_shows():
    (code,) = page.blocks("index.md")
    env = run(code)["env"]
    assert env.reset(seed=1)[0] == [5.0]
    rewards = [env.step(action)[1] for action in (1, 1, 0, 1, 1)]
    assert rewards == [-1.0, -2.0, -1.0, -2.0, -3.0]
    env.close()


def test_pictures_and_links_of_the_readme_lead_to_files():
    """No badge stands for a service that does not exist."""
    root = page.DOCS.parent
    text = (root / "README.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^]]*\]\(([^)]*)\)", text)
    links = [link for link in re.findall(r"\]\(([^)]*)\)", text) if not link.startswith("https://")]
    assert pictures
    assert [path for path in (*pictures, *links) if not (root / path).is_file()] == []


def turns(env, seed):
    """What is told in an episode of random actions, turn by turn."""
    actions, told = random.Random(seed), []
    env.reset(seed=seed)
    for agent in env.agent_iter():
        observation, reward, terminated, truncated, _ = env.last()
        told.append((agent, observation.tolist(), reward, terminated, truncated))
        env.step(None if terminated or truncated else actions.randrange(4))
    return told


def test_a_hand_written_environment_and_its_successor_tell_the_same():
    before, after = map(run, page.blocks("coming-from.md", "PettingZoo"))
    told = [turns(before["StallEnv"](), seed) for seed in range(20)]
    assert told == [turns(after["env"], seed) for seed in range(20)]
    assert len({len(episode) for episode in told}) > 3  # the seller is not asked every day


def test_the_environment_of_the_paper_in_todays_words(monkeypatch):
    monkeypatch.setitem(sys.modules, "model", model)
    (code,) = page.blocks("coming-from.md", "Sim-Env")
    names = run(code)
    assert names["terminated"]
    assert names["alive"](names["env"].simulation.greenhouse) == 0
    assert -1 <= names["reward"] <= 1
    names["env"].close()


def test_the_page_quotes_what_the_library_says_and_names_errors_that_there_are():
    text = (page.DOCS / "problems.md").read_text(encoding="utf-8")
    quoted = re.findall(r"^### (.+)$", text, re.MULTILINE)  # the headings
    assert len(quoted) >= 20
    sources = (path.read_text(encoding="utf-8") for path in SOURCES.rglob("*.py"))
    said = "".join(re.sub(r'"\s+f?"', "", source) for source in sources)  # each text in one line
    for quote in quoted:
        parts = [re.escape(part.strip()) for part in quote.replace("`", "").split("...")]
        assert re.search(".*".join(parts), said), quote
    named = set(re.findall(r"`([A-Z]\w+Error)`", text))
    assert {name for name in named if not hasattr(builtins, name)} <= set(simenv_marl.errors.__all__)


TERMS = (
    "parameter sharing", "centralised training", "CTDE", "self-play", "black death", "discrete-event simulation",
    "agent-based model", "semi-MDP", "callback", "hook", "DAgger", "action mask", "PPO", "wrapper", "seed", "pickle",
    "AEC", "turn-based", "MARL", "behavior cloning",
)  # fmt: skip


def test_the_glossary_explains_the_terms_that_users_search_for():
    assert set(TERMS) <= set((page.DOCS / "glossary.md").read_text(encoding="utf-8").splitlines())
