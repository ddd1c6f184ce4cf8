"""PPO in one file, on the vector view of the bakery."""

import numpy as np
import torch
from bakery_env import FourWeeks, batch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import nn
from torch.distributions import Categorical

from simenv_marl import vector_env

torch.manual_seed(1)
steps, gamma, gae_lambda, clip = 56, 0.5, 0.95, 0.2
points = {"bakery.Bakery.choose_batch": batch}
envs = vector_env(FourWeeks, points, num_envs=8, autoreset_mode="SameStep")
envs = RecordEpisodeStatistics(envs)
actor = nn.Sequential(nn.Linear(2, 64), nn.Tanh(), nn.Linear(64, 5))
critic = nn.Sequential(nn.Linear(2, 64), nn.Tanh(), nn.Linear(64, 1))
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=3e-3)


def seen(observations):
    """Scale observations."""
    return torch.as_tensor(observations / 50)


def train(updates):
    """Train by PPO."""
    observations, _ = envs.reset(seed=1)
    for _ in range(updates):
        rows = []
        for _ in range(steps):
            state = seen(observations)
            with torch.no_grad():
                policy, value = Categorical(logits=actor(state)), critic(state).squeeze(1)
            action = policy.sample()
            observations, rewards, terminations, truncations, _ = envs.step(action.numpy())
            rewards = torch.as_tensor(rewards / 100)
            going_on = torch.as_tensor(1.0 - (terminations | truncations))
            rows.append((state, action, policy.log_prob(action), value, rewards, going_on))
        stacks = (torch.stack(part) for part in zip(*rows, strict=True))
        states, actions, log_probs, values, rewards, going_on = stacks
        with torch.no_grad():
            following = torch.cat([values[1:], critic(seen(observations)).T])
        advantages, last = torch.zeros(steps, 8), 0.0
        for step in reversed(range(steps)):
            error = rewards[step] + gamma * following[step] * going_on[step] - values[step]
            advantages[step] = last = error + gamma * gae_lambda * going_on[step] * last
        returns, states = (advantages + values).flatten(), states.flatten(0, 1)
        advantages = ((advantages - advantages.mean()) / advantages.std()).flatten()
        for _ in range(4):
            for part in torch.randperm(steps * 8).split(112):
                policy = Categorical(logits=actor(states[part]))
                ratio = (policy.log_prob(actions.flatten()[part]) - log_probs.flatten()[part]).exp()
                clipped = ratio.clamp(1 - clip, 1 + clip)
                gain = torch.min(ratio * advantages[part], clipped * advantages[part])
                value_loss = (critic(states[part]).squeeze(1) - returns[part]).square().mean()
                loss = -gain.mean() + 0.5 * value_loss - 0.01 * policy.entropy().mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()


if __name__ == "__main__":
    train(21)
    print(actor(seen(np.array([[5, 38]], np.float32))).argmax().item())
