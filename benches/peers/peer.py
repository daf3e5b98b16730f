"""Trains a recipe of this project with Stable-Baselines3 or Tianshou on one thread, and prints what came out as JSON.

    python peer.py sb3|tianshou RECIPE.toml SEED

The recipe's [run], [policy], [ppo] and [adam] are what the library is given; it must be one of plain layers with a log standard
deviation that is a parameter, or of discrete actions. The time is the processor's, of training alone: no imports, set-up or tests.
"""
import json
import sys
import time
import tomllib

import gymnasium
import numpy as np
import torch

TASKS = {"cartpole": "CartPole-v1", "pendulum": "Pendulum-v1"}


def sb3(recipe, task, seed):
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    run, ppo, adam = recipe["run"], recipe["ppo"], recipe["adam"]
    decay = lambda x, linear: (lambda left: x * left) if linear else x
    model = PPO(
        "MlpPolicy",
        make_vec_env(task, n_envs=run["envs"], seed=seed),
        n_steps=run["collect_steps"] // run["envs"],
        batch_size=ppo["batch"],
        n_epochs=ppo["passes"],
        gamma=ppo["gamma"],
        gae_lambda=ppo["lambda"],
        clip_range=decay(ppo["clip"], ppo.get("linear_clip")),
        learning_rate=decay(adam["lr"], adam.get("schedule") == "linear"),
        ent_coef=ppo["entropy"],
        vf_coef=ppo["value"],
        max_grad_norm=ppo["max_grad_norm"],
        policy_kwargs={
            "net_arch": recipe["policy"]["hidden"],
            "log_std_init": recipe["policy"].get("log_std", 0.0),
            "optimizer_kwargs": {"eps": adam["eps"]},
        },
        seed=seed,
        device="cpu",
    )
    start = time.process_time()
    model.learn(run["epochs"] * run["epoch_steps"])
    return time.process_time() - start, model.num_timesteps, lambda obs: model.predict(obs, deterministic=True)[0]


def tianshou(recipe, task, seed):
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.policy import PPOPolicy
    from tianshou.trainer import OnpolicyTrainer
    from tianshou.utils.net.common import ActorCritic
    from torch import nn
    from torch.distributions import Categorical, Independent, Normal

    run, ppo, adam = recipe["run"], recipe["ppo"], recipe["adam"]
    env = gymnasium.make(task)
    discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)
    outputs = int(env.action_space.n) if discrete else env.action_space.shape[0]

    class Net(nn.Module):
        def __init__(self, output, gain):
            super().__init__()
            widths = [env.observation_space.shape[0], *recipe["policy"]["hidden"]]
            layers = []
            for a, b in zip(widths, widths[1:]):
                layers += [nn.Linear(a, b), nn.Tanh()]
            self.layers = nn.Sequential(*layers, nn.Linear(widths[-1], output))
            for layer in self.layers[::2]:
                nn.init.orthogonal_(layer.weight, 2**0.5)
                nn.init.zeros_(layer.bias)
            self.layers[-1].weight.data *= gain

        def forward(self, obs):
            return self.layers(torch.as_tensor(obs, dtype=torch.float32))

    class Actor(Net):
        def __init__(self):
            super().__init__(outputs, 0.01)
            self.log_std = None if discrete else nn.Parameter(torch.full((outputs,), recipe["policy"]["log_std"]))

        def forward(self, obs, state=None, info=None):
            out = super().forward(obs)
            return (out if discrete else (out, self.log_std.exp().expand_as(out))), state

    actor, critic = Actor(), Net(1, 1.0)
    optim = torch.optim.Adam(ActorCritic(actor, critic).parameters(), lr=adam["lr"], eps=adam["eps"])
    total = run["epochs"] * run["epoch_steps"]
    updates = total // run["collect_steps"]
    decay = torch.optim.lr_scheduler.LambdaLR(optim, lambda n: max(0.0, 1 - n / updates))
    policy = PPOPolicy(
        actor,
        critic,
        optim,
        (lambda logits: Categorical(logits=logits)) if discrete else (lambda mu, std: Independent(Normal(mu, std), 1)),
        discount_factor=ppo["gamma"],
        gae_lambda=ppo["lambda"],
        eps_clip=ppo["clip"],
        vf_coef=ppo["value"],
        ent_coef=ppo["entropy"],
        max_grad_norm=ppo["max_grad_norm"],
        action_space=env.action_space,
        # The bounds that it would clip to are -1 and 1, whatever the task's are; the tasks clip by themselves.
        action_scaling=False,
        action_bound_method="",
        deterministic_eval=True,
        lr_scheduler=decay if adam.get("schedule") == "linear" else None,
    )
    envs = DummyVectorEnv([lambda: gymnasium.make(task)] * run["envs"])
    envs.seed(seed)
    collector = Collector(policy, envs, VectorReplayBuffer(run["collect_steps"], run["envs"]))

    def before(epoch, step):
        if ppo.get("linear_clip"):
            policy._eps_clip = ppo["clip"] * (1 - step / total)

    trainer = OnpolicyTrainer(
        policy,
        collector,
        None,
        max_epoch=run["epochs"],
        step_per_epoch=run["epoch_steps"],
        repeat_per_collect=ppo["passes"],
        episode_per_test=0,
        batch_size=ppo["batch"],
        step_per_collect=run["collect_steps"],
        train_fn=before,
        verbose=False,
        show_progress=False,
    )
    start = time.process_time()
    trainer.run()

    @torch.no_grad()
    def act(obs):
        out = actor(obs)[0]
        return out.argmax(1).numpy() if discrete else policy.map_action(out[0].numpy())

    return time.process_time() - start, collector.collect_step, act


def test(task, act, episodes, seed):
    """Mean return of that many episodes without noise."""
    envs = [gymnasium.make(task) for _ in range(episodes)]
    obs = np.stack([env.reset(seed=seed + i)[0] for i, env in enumerate(envs)])
    totals, open_ = np.zeros(episodes), np.ones(episodes, bool)
    while open_.any():
        for i, action in enumerate(act(obs)):
            if open_[i]:
                obs[i], reward, terminated, truncated, _ = envs[i].step(action)
                totals[i] += reward
                open_[i] = not (terminated or truncated)
    return float(totals.mean())


def main(library, path, seed):
    with open(path, "rb") as file:
        recipe = tomllib.load(file)
    torch.set_num_threads(1)
    np.random.seed(seed)
    torch.manual_seed(seed)
    task = TASKS[recipe["env"]]
    seconds, steps, act = {"sb3": sb3, "tianshou": tianshou}[library](recipe, task, seed)
    result = test(task, act, recipe["test"]["episodes"], 1000)
    print(json.dumps({"return": result, "steps": int(steps), "steps_per_second": steps / seconds}))


main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
