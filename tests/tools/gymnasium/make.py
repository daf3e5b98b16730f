"""Writes tests/fixtures/gymnasium/control.safetensors: whole episodes of Gymnasium's classic control tasks.

Each is named TASK.CASE and holds start (state), elapsed (steps before it; the step limit counts them), action (T),
obs (T+1, O), reward (T) and end (terminated, truncated); the episode ends with the last action and not before.
Run from the repository root: python tests/tools/gymnasium/make.py
"""
import pathlib

import gymnasium
import numpy as np
from safetensors.numpy import save_file

rng = np.random.default_rng(11)


def first_obs(env, state, elapsed):
    """Places the task in `state`, `elapsed` steps into its episode; Gymnasium has no way to do this but its attributes."""
    env.reset(seed=0)
    limit, task = env, env.unwrapped
    while not isinstance(limit, gymnasium.wrappers.TimeLimit):
        limit = limit.env
    limit._elapsed_steps = elapsed
    task.state = np.array(state, dtype=np.float64)
    for name in ("_get_ob", "_get_obs"):
        if hasattr(task, name):
            return getattr(task, name)()
    return task.state.astype(np.float32)


def episode(env_id, start, act, elapsed=0):
    env = gymnasium.make(env_id)
    if isinstance(env.action_space, gymnasium.spaces.Box):
        env = gymnasium.wrappers.ClipAction(env)
    start = np.array(start, dtype=np.float32)
    obs, actions, rewards, end = [first_obs(env, start, elapsed)], [], [], (False, False)
    while not any(end):
        actions.append(np.float32(act(obs[-1])))
        discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)
        given = int(actions[-1]) if discrete else np.array([actions[-1]], dtype=np.float32)
        o, reward, *end, _ = env.step(given)
        obs.append(o)
        rewards.append(reward)
    f = lambda x: np.ascontiguousarray(x, dtype=np.float32)
    print(f"{env_id:26}{len(actions):5} steps, return {sum(rewards):9.2f}, terminated {end[0]}, truncated {end[1]}")
    end, elapsed = np.array(end, dtype=np.uint8), np.array([elapsed], dtype=np.int32)
    return {"start": start, "elapsed": elapsed, "action": f(actions), "obs": f(obs), "reward": f(rewards), "end": end}


def balance(lean, slow):
    """Pushes towards where the pole leans; `lean` shifts the wanted angle, `slow` holds the cart's speed and place."""
    return lambda o: float(o[2] + 0.3 * o[3] + slow * (o[0] + o[1]) > lean)


# Long episodes are entered late: the tasks are unstable, and roundings grow with every step.
EPISODES = {
    "cartpole.fall": ("CartPole-v1", [0.01, -0.02, 0.03, 0.04], lambda o: 1.0),
    "cartpole.leave": ("CartPole-v1", [0.0, 0.0, 0.0, 0.0], balance(0.04, 0.0)),
    "cartpole.hold": ("CartPole-v1", [-0.05, 0.05, 0.05, -0.05], balance(0.0, 0.05), 300),
    # Torque against the upper link's motion puts energy in.
    "acrobot.pump": ("Acrobot-v1", [0.05, -0.1, 0.02, 0.0], lambda o: 1.0 - np.sign(o[4])),
    # Fast enough that angles wrap and speeds meet their limits.
    "acrobot.whirl": ("Acrobot-v1", [0.2, 3.0, -1.0, 28.0], lambda o: 2.0),
    "acrobot.idle": ("Acrobot-v1", [0.1, -0.1, 0.05, 0.1], lambda o: float(rng.integers(0, 3)), 350),
    # Torques beyond 2 are cut.
    "pendulum.random": ("Pendulum-v1", [-2.0, 0.5], lambda o: rng.uniform(-3, 3)),
    "pendulum.spin": ("Pendulum-v1", [3.0, 7.9], lambda o: 2.5),
    "mountaincar.swing": ("MountainCar-v0", [-0.5, 0.0], lambda o: 1.0 + np.sign(o[1])),
    # Rolls into the left end.
    "mountaincar.random": ("MountainCar-v0", [-1.1, -0.06], lambda o: float(rng.integers(0, 3))),
    "mountaincar_continuous.swing": ("MountainCarContinuous-v0", [-0.45, 0.0], lambda o: 1.3 * np.sign(o[1])),
    "mountaincar_continuous.random": ("MountainCarContinuous-v0", [-1.15, -0.03], lambda o: rng.normal(0, 0.3), 849),
}

out = {}
for name, case in EPISODES.items():
    out |= {f"{name}.{key}": value for key, value in episode(*case).items()}
path = pathlib.Path(__file__).resolve().parents[2] / "fixtures" / "gymnasium" / "control.safetensors"
path.parent.mkdir(exist_ok=True)
save_file(out, path)
