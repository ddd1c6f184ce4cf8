"""The turn view: one learner takes decisions that arise at irregular moments."""

import heapq

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import MaskablePPO

from simenv_marl import difference, evaluate, joint_env, make_step, turn_env
from simenv_marl.data import joint_policy, turn_policy

NEEDS = 5
PATIENTS = 40


class Clinic:
    """Patients see a nurse, a doctor and the laboratory, each after a random time.

    Each decision is right if it meets the patient's need at that moment. The rules miss the last of
    five needs.
    """

    def reset(self, seed=None):
        self.random = np.random.default_rng(seed)
        self.right = 0
        self.need = 0

    def run(self):
        events = [(self.random.exponential(20), patient, 0) for patient in range(PATIENTS)]
        heapq.heapify(events)
        while events:
            time, patient, stage = heapq.heappop(events)
            self.need = int(self.random.integers(NEEDS))
            decide = (self.triage, self.treat, self.analyse)[stage]
            self.right += decide() == self.need
            if stage < 2:
                heapq.heappush(events, (time + self.random.exponential(5), patient, stage + 1))

    def triage(self):
        return min(self.need, NEEDS - 2)

    def treat(self):
        return min(self.need, NEEDS - 2)

    def analyse(self):
        return min(self.need, NEEDS - 2)


def kind(agent, actions):
    """A decision point with so many actions, of which those beyond the needs are illegal."""
    return make_step(
        agent=agent,
        observation_space=spaces.Box(0, 1, (NEEDS,), np.float32),
        observation_space_mapping=lambda clinic: np.eye(NEEDS)[clinic.need],
        action_space=spaces.Discrete(actions),
        action_space_mapping=lambda action: action,
        action_mask_mapping=lambda clinic: np.arange(actions) < NEEDS,
        reward_mapping=lambda clinic: 0.0,
    )


POINTS = {
    Clinic.triage: kind("nurse", NEEDS),
    Clinic.treat: kind("doctor", NEEDS + 2),
    Clinic.analyse: kind("laboratory", NEEDS + 1),
}
TEAM = {"team_reward": difference(lambda clinic: clinic.right)}


@pytest.mark.filterwarnings("ignore:of [0-9]+ actions in this episode")
def test_turn_env_learner_beats_the_models_rule():
    contenders = {"rule": {}}
    for name, make, policy_of in (
        ("turn", turn_env, turn_policy),
        ("joint", joint_env, joint_policy),
    ):
        env = make(Clinic, POINTS, flatten=True, **TEAM)
        learner = MaskablePPO(
            "MlpPolicy", env, n_steps=600, batch_size=100, learning_rate=2e-3, gamma=0.5, seed=0
        )
        learner.learn(18_000)

        def predict(observation, info, learner=learner, is_turn=name == "turn"):
            masks = info["action_mask"]
            if not is_turn:
                masks = [masks.get(agent) for agent in ("nurse", "doctor", "laboratory")]
                sizes = (NEEDS, NEEDS + 2, NEEDS + 1)
                masks = np.concatenate(
                    [
                        np.arange(size) < NEEDS if mask is None else mask
                        for mask, size in zip(masks, sizes, strict=True)
                    ]
                )
            return learner.predict(observation, action_masks=masks, deterministic=True)

        contenders[name] = policy_of(predict, like=env)
    found = evaluate(
        Clinic, contenders, seeds=range(100, 130), points=POINTS, baseline="rule", **TEAM
    )
    summary = found.summary()
    assert summary.loc["turn", "difference_low"] > 0
    assert summary.loc["joint", "difference_high"] < 0
