"""Stable-Baselines3 on MountainCarContinuous-v0 by RL Baselines3 Zoo's settings: the return without noise of several seeds.

    venv/bin/python mountaincar_continuous.py --seeds 10
"""
import argparse

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

torch.set_num_threads(1)
parser = argparse.ArgumentParser()
parser.add_argument("--seeds", type=int, default=10)
for seed in range(parser.parse_args().seeds):
    env = VecNormalize(make_vec_env("MountainCarContinuous-v0", n_envs=1, seed=seed), gamma=0.9999)
    # n_steps 8 makes minibatches of 8, whatever batch_size says.
    model = PPO(
        "MlpPolicy", env, seed=seed, n_steps=8, batch_size=8, gamma=0.9999, learning_rate=7.77e-5, ent_coef=0.00429, clip_range=0.1,
        n_epochs=10, gae_lambda=0.9, max_grad_norm=5, vf_coef=0.19, use_sde=True, policy_kwargs=dict(log_std_init=-3.29, ortho_init=False),
    )  # fmt: skip
    model.learn(20_000)
    env.training, env.norm_reward = False, False
    mean, _ = evaluate_policy(model, env, n_eval_episodes=16, deterministic=True)
    print(f"seed {seed}: {mean:.1f}", flush=True)
