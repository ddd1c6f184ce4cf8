"""Self-play with a pool of opponents, as the page has it."""

import runpy

from .page import DOCS


def test_self_play_generations_beat_the_models_rule():
    street = runpy.run_path(str(DOCS / "street.py"))
    pool = street["train"](generations=1, steps=4_000)
    found = street["rate"](dict(enumerate(pool.policies)), seeds=range(10))
    assert found[1, 0] > found[0, 0] + 100
    assert found[1, 0] > found[0, 1] + 100
