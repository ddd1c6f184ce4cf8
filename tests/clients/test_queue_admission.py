"""Stable-Baselines3 with a discount for each transition, on decisions at irregular times."""

from examples.queue_admission import train
from examples.queue_admission.exact import ADMIT_ALL, worth


def test_queue_admission_training_by_time_beats_training_by_decision():
    """By decision, the best table admits all: see ``tests/examples/test_queue_admission.py``."""
    assert worth(train.table_of(train.train_dqn(0, steps=20_000))) > 1.1 * worth(ADMIT_ALL)


def test_queue_admission_command_writes_a_row_per_training_and_a_figure(tmp_path):
    results, figure = tmp_path / "results.csv", tmp_path / "figure.png"
    train.main(
        [
            "--seeds",
            "1",
            "--steps",
            "500",
            "--runs",
            "3",
            "--out",
            str(results),
            "--figure",
            str(figure),
        ]
    )
    assert len(results.read_text().splitlines()) == 1 + 2 + len(train.GAMMAS)
    assert figure.stat().st_size > 10_000
