"""Mesa's example models as environments: with RULE as in the plain run, with actions otherwise."""

import re
from pathlib import Path

import mesa
import pytest

from examples import mesa_models

# Mesa's own, before 3.5
pytestmark = pytest.mark.filterwarnings("ignore:Random number generator not specified")

PAGE = Path(__file__).parents[2] / "docs" / "mesa.md"


def told_of(model):
    """The cells of a model's row in the table of the page."""
    line = re.search(rf"^\| `{model}` \|.*$", PAGE.read_text(), re.MULTILINE)
    return [cell.strip() for cell in line[0].strip("|").split("|")]


@pytest.mark.thorough
@pytest.mark.parametrize("example", mesa_models.EXAMPLES, ids=lambda example: example.__name__)
def test_mesa_example_envs_with_rule_actions_run_like_models_without_env(example):
    if example is mesa_models.wolf_sheep and mesa_models.NEEDS_SIMULATOR:
        pytest.skip("this Mesa runs it by a simulator: tests/contract/test_mesa.py")
    outcome = mesa_models.outcome(example)
    assert outcome.same
    assert outcome.moved
    assert outcome.agents == 1 or outcome.asked > 5 * outcome.agents
    printed = [
        cell.strip() for cell in mesa_models.table([outcome]).splitlines()[-1].strip("|").split("|")
    ]
    if mesa.__version__ in PAGE.read_text():
        assert printed == told_of(outcome.model)
    else:  # chance is drawn in another order
        assert printed[:3] == told_of(outcome.model)[:3]


def test_mesa_example_program_prints_a_table(capsys):
    mesa_models.main(["boltzmann_wealth"])
    assert "| `BoltzmannWealth` | `MoneyAgent.move` |" in capsys.readouterr().out


def test_mesa_example_covers_every_model_of_mesa():
    assert {example()[0].__name__ for example in mesa_models.EXAMPLES} >= set(mesa.examples.__all__)
