"""What factors do."""

import numpy as np
import pytest

from simenv_marl import OptionValueError, design, effects, run_experiment, sobol_indices


class Sum:
    """A model that decides nothing, and of which all effects are known."""

    def __init__(self, a, b, c="x", noise=0.0):
        self.a, self.b, self.c, self.noise = a, b, c, noise

    def reset(self, seed):
        self.generator = np.random.default_rng(seed)

    def run(self):
        self.y = self.a + 2 * self.b * (1 if self.c == "x" else 3) + self.noise * self.generator.normal()


def results(table, store, **arguments):
    from tests.worlds.shops import POINTS

    return run_experiment(
        Sum, table, points=POINTS, metric={"y": lambda s: s.y}, store=store, seeds=[1, 2], **arguments
    )


def test_main_effects_and_interactions_are_those_of_the_model(tmp_path):
    found = effects(results(design({"a": [0, 1], "b": (0.0, 1.0), "c": ["x", "y"]}), tmp_path), "y")
    assert list(found.main.columns) == ["mean", "low", "high", "effect", "count"]
    assert found.main.loc[("a", 1), "effect"] - found.main.loc[("a", 0), "effect"] == pytest.approx(1)
    assert found.main.loc[("b", 1.0), "effect"] - found.main.loc[("b", 0.0), "effect"] == pytest.approx(4)
    strengths = found.interactions["strength"]
    assert strengths.index[0] == ("b", "c")
    assert strengths.iloc[0] == pytest.approx(1.0)
    assert strengths.iloc[1:].tolist() == pytest.approx([0, 0], abs=1e-9)
    cells = found.cells("b", "c")
    assert (cells.loc[1.0, "y"] - cells.loc[1.0, "x"]) == pytest.approx(4)
    assert found.cells("c", "b").equals(cells.T)
    drawn = found.plot().axes
    assert sum(axes.get_visible() for axes in drawn) == 4
    with pytest.raises(OptionValueError, match="no two factors"):
        found.cells("a", "z")


def test_many_numbers_are_grouped(tmp_path):
    found = effects(results(design({"a": (0.0, 1.0), "b": (0.0, 1.0)}, "sobol", 64), tmp_path), "y")
    assert found.main.loc["a"]["count"].tolist() == [32] * 4
    assert found.main.loc["b"]["mean"].is_monotonic_increasing
    found.plot()


def test_sobol_indices_are_those_of_the_model(tmp_path):
    frame = results(design({"a": (0.0, 1.0), "b": (0.0, 1.0)}, "saltelli", 512), tmp_path)
    found = sobol_indices(frame, "y")
    assert list(found.index) == ["a", "b"]
    assert found["first"].tolist() == pytest.approx([0.2, 0.8], abs=0.03)
    assert found["total"].tolist() == pytest.approx([0.2, 0.8], abs=0.03)


def test_what_cannot_be_is_refused(tmp_path):
    frame = results(design({"a": (0.0, 1.0), "b": (0.0, 1.0)}, "sobol", 6), tmp_path)
    with pytest.raises(OptionValueError, match="saltelli"):
        sobol_indices(frame, "y")
    with pytest.raises(OptionValueError, match="no column with values"):
        effects(frame, "a")
    with pytest.raises(OptionValueError, match="no contender 'x'"):
        effects(frame, "y", contender="x")
    with pytest.raises(OptionValueError, match="what run_experiment has returned"):
        effects(frame[["a"]])
    with pytest.raises(OptionValueError, match="no variance"):
        sobol_indices(results(design({"a": (0.0, 1.0), "b": (0.0, 1.0)}, "saltelli", 2), tmp_path / "b"), "return")
