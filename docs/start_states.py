"""An environment whose episodes start from random files of a folder."""

from pathlib import Path

import gymnasium

from simenv_marl import load_episode


class StartStates(gymnasium.Env):
    """A single, joint or turn view that starts where saved episodes stand."""

    def __init__(self, folder, **options):
        """Load the first file, for its spaces."""
        self.files = sorted(Path(folder).glob("*.jsonl"))
        self.options = options
        self.env = load_episode(self.files[0], **options)
        self.observation_space = self.env.observation_space
        self.action_space = self.env.action_space

    def reset(self, *, seed=None, options=None):
        """Load a random file."""
        super().reset(seed=seed)
        self.env.close()
        self.env = load_episode(self.np_random.choice(self.files), **self.options)
        observation, *_, info = self.env.latest
        return observation, info

    def step(self, action):
        """Take a step in the loaded episode."""
        return self.env.step(action)

    def close(self):
        """Close the loaded environment."""
        self.env.close()
