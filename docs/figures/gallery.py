"""Draw comparisons with the rule for the gallery of the front page: the policies of the templates, the town in Java.

Run ``OMP_NUM_THREADS=1 python -m docs.figures.gallery`` from the root of the repository, after
``pip install ".[clients]"``. The town needs a JDK.
"""

from pathlib import Path
from runpy import run_module

from examples.jvm_market.compare import compare

from simenv_marl import evaluate
from simenv_marl.experiments import Evaluation

HERE = Path(__file__).parent


def of_template(kind: str) -> Evaluation:
    """Run a template, which trains its policy, and compare the policy with the rule."""
    names = run_module(f"simenv_marl.testing.templates.{kind}", run_name="__main__")
    return evaluate(names["MySimulation"], names["policies"], seeds=names["seeds"], baseline="rule")


def main() -> None:
    """Save all pictures."""
    for kind in ("plain", "simpy", "mesa"):
        of_template(kind).plot().savefig(HERE / f"template-{kind}.png", dpi=100)
    compare(seeds=range(20), weeks=52).plot().savefig(HERE / "jvm-market.png", dpi=100)


if __name__ == "__main__":
    main()
