"""Numbers for the PPO tests, from NumPy and PyTorch alone. Writes ../../fixtures/ppo.safetensors.

    python -m venv venv && venv/bin/pip install -r requirements.txt && venv/bin/python make.py
"""
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file
from torch.distributions import Independent, Normal, kl_divergence

OUT = {}
torch.manual_seed(3)
rng = np.random.default_rng(3)


def put(name, value):
    if isinstance(value, torch.Tensor):
        value = value.detach().numpy()
    OUT[name] = np.array(value, dtype=np.float32, order="C")


def gae(steps=9, envs=4, gamma=0.93, lam=0.8):
    """Advantages as the explicit sum over each episode's remaining deltas."""
    reward, value, after = rng.normal(size=(3, steps, envs))
    end = rng.random((steps, envs))
    terminated, truncated = end < 0.2, (end >= 0.2) & (end < 0.4)
    delta = reward + gamma * np.where(terminated, 0, after) - value
    adv = np.zeros_like(reward)
    for i in range(envs):
        for t in range(steps):
            for k in range(t, steps):
                adv[t, i] += (gamma * lam) ** (k - t) * delta[k, i]
                if terminated[k, i] or truncated[k, i]:
                    break
    for name, v in dict(reward=reward, value=value, next_value=after, terminated=terminated, truncated=truncated, advantage=adv).items():
        put(f"gae.{name}", v)


class Policy(torch.nn.Module):
    """The layout of src/agent/spec.rs: state [2,7], rays [3,4], dist [1], plain [3]."""

    def __init__(self, trunk, actions=4, octaves=3):
        super().__init__()
        self.octaves, self.actions = octaves, actions
        self.encoder = torch.nn.ModuleDict({"state": torch.nn.GRU(7, 6, batch_first=True), "rays": torch.nn.GRU(4, 5, batch_first=True)})
        encoded = 6 + 5 + 2 * octaves + 3
        if trunk:
            self.project = torch.nn.Linear(encoded, trunk)
        width = trunk or encoded
        head = lambda out: torch.nn.ModuleDict(
            {str(b): torch.nn.ModuleList([torch.nn.Linear(width, width), torch.nn.Linear(width, width)]) for b in range(2)}
            | {"out": torch.nn.Linear(width, out)}
        )
        self.actor, self.critic = head(2 * actions), head(1)

    def run(self, head, h):
        for b in "01":
            x = h
            for layer in head[b]:
                x = torch.nn.functional.leaky_relu(layer(x), 0.01)
            h = x + h
        return head["out"](h)

    def forward(self, obs):
        state, rays, dist, plain = obs.split([14, 12, 1, 3], 1)
        angle = dist * 2.0 ** torch.arange(self.octaves)
        gru = lambda name, x: self.encoder[name](x)[1][0]
        h = [gru("state", state.reshape(-1, 2, 7)), gru("rays", rays.reshape(-1, 3, 4)), angle.sin(), angle.cos(), plain]
        h = torch.cat(h, 1)
        if hasattr(self, "project"):
            h = self.project(h)
        mu, logvar = self.run(self.actor, h).split(self.actions, 1)
        return mu, logvar.clamp(-0.15, 0.15), self.run(self.critic, h)[:, 0]


def loss(name, trunk, rows=13, clip=0.2, c1=0.7, c2=0.05, w=0.4):
    net = Policy(trunk)
    obs, action = torch.randn(rows, 30), torch.randn(rows, 4)
    mu, logvar, value = net(obs)
    pi = Independent(Normal(mu, (logvar / 2).exp()), 1)
    old = (pi.log_prob(action) + 0.3 * torch.randn(rows)).detach()
    adv, ret = torch.randn(rows) * 3 + 1, torch.randn(rows)
    norm = (adv - adv.mean()) / (adv.std() + 1e-8)
    ratio = (pi.log_prob(action) - old).exp()
    policy = -torch.minimum(ratio * norm, ratio.clamp(1 - clip, 1 + clip) * norm).mean()
    vf = (ret - value).pow(2).mean()
    entropy = pi.entropy().mean()
    prior = kl_divergence(Normal(mu, (logvar / 2).exp()), Normal(torch.zeros_like(mu), torch.ones_like(mu))).mean()
    (policy + c1 * vf - c2 * entropy + w * prior).backward()
    for key, p in net.named_parameters():
        put(f"{name}.param/{key}", p)
        put(f"{name}.grad/{key}", p.grad)
    k3 = ((ratio - 1) - ratio.log()).mean()
    fraction = ((ratio - 1).abs() > clip).float().mean()
    figures = torch.stack([policy, vf, entropy, prior, k3, fraction])
    for key, v in dict(obs=obs, action=action, old=old, advantage=adv, returns=ret, mu=mu, logvar=logvar, value=value, figures=figures).items():
        put(f"{name}.{key}", v)
    clamped = (logvar.abs() == 0.15).float().mean().item()
    assert 0.05 < clamped < 0.95 and 0 < fraction < 1, "the case does not reach every branch"


def adam(count=11, steps=5):
    p = torch.nn.Parameter(torch.randn(count))
    opt = torch.optim.AdamW([p], lr=1e-2)
    grads = torch.randn(steps, count) * torch.tensor([0.02, 1.0, 3.0, 0.05, 1.0])[:, None]
    put("adam.start", p)
    norms, path = [], []
    for g in grads:
        p.grad = g.clone()
        norms.append(torch.nn.utils.clip_grad_norm_([p], 0.5))
        opt.step()
        path.append(p.detach().clone())
    put("adam.grads", grads)
    put("adam.norms", torch.stack(norms))
    put("adam.path", torch.stack(path))


gae()
loss("sum", None)
loss("project", 10)
adam()
save_file(OUT, Path(__file__).parents[2] / "fixtures" / "ppo.safetensors")
