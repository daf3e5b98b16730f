"""Scaled rewards and noise that depends on the state (gSDE), from Stable-Baselines3. Writes ../../fixtures/sb3.safetensors.

    python -m venv venv && venv/bin/pip install -r requirements.txt && venv/bin/python make.py
"""
from pathlib import Path

import gymnasium
import numpy as np
import torch
from safetensors.numpy import save_file
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

OUT = {}
rng = np.random.default_rng(4)
torch.manual_seed(4)


def put(name, value):
    if isinstance(value, torch.Tensor):
        value = value.detach().numpy()
    OUT[name] = np.array(value, dtype=np.float32, order="C")


class Replay(VecEnv):
    """Environments that give recorded rewards and ends."""

    def __init__(self, reward, done):
        space = gymnasium.spaces.Box(-1, 1, (1,))
        super().__init__(reward.shape[1], space, space)
        self.rows = iter(zip(reward, done))

    def reset(self):
        return np.zeros((self.num_envs, 1))

    def step_wait(self):
        reward, done = next(self.rows)
        return self.reset(), reward.copy(), done, [{"terminal_observation": np.zeros(1)} for _ in done]

    def step_async(self, actions):
        pass

    def close(self):
        pass

    def get_attr(self, name, indices=None):
        return [None] * self.num_envs

    set_attr = env_method = env_is_wrapped = None


def scaling(steps=40, envs=3, gamma=0.9):
    reward = rng.normal(size=(steps, envs)) * 0.1
    # So rare a reward is cut.
    reward[steps - 3, 1] = 60.0
    done = rng.random((steps, envs)) < 0.15
    venv = VecNormalize(Replay(reward.astype(np.float32), done), norm_obs=False, gamma=gamma)
    venv.reset()
    put("scaling.reward", reward)
    put("scaling.done", done)
    put("scaling.scaled", [venv.step(np.zeros((envs, 1)))[1] for _ in range(steps)])


def gsde(rows=11, inputs=3, width=5, actions=2):
    """An actor of one tanh layer; log densities, entropies and the gradients of a weighted sum of them."""
    parameter = lambda *shape: torch.tensor(rng.normal(size=shape) * 0.5, dtype=torch.float32, requires_grad=True)
    layers = {"actor.0.weight": parameter(width, inputs), "actor.0.bias": parameter(width)}
    layers |= {"actor.out.weight": parameter(actions, width), "actor.out.bias": parameter(actions), "actor.log_std": parameter(width, actions)}
    obs, action = (torch.tensor(rng.normal(size=(rows, n)), dtype=torch.float32) for n in (inputs, actions))
    weights = torch.tensor(rng.normal(size=rows), dtype=torch.float32)
    latent = torch.tanh(obs @ layers["actor.0.weight"].T + layers["actor.0.bias"])
    mean = latent @ layers["actor.out.weight"].T + layers["actor.out.bias"]
    dist = StateDependentNoiseDistribution(actions).proba_distribution(mean, layers["actor.log_std"], latent)
    log_prob, entropy = dist.log_prob(action), dist.entropy()
    (weights * log_prob + 0.3 * entropy).sum().backward()
    for name, value in dict(obs=obs, action=action, weights=weights, mean=mean, log_prob=log_prob, entropy=entropy).items():
        put(f"gsde.{name}", value)
    put("gsde.logvar", dist.distribution.variance.log())
    for name, tensor in layers.items():
        put(f"gsde/{name}", tensor)
        put(f"gsde/gradient/{name}", tensor.grad)


scaling()
gsde()
save_file(OUT, Path(__file__).parent / "../../fixtures/sb3.safetensors")
