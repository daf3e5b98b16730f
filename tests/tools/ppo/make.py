"""Numbers for the PPO tests, from NumPy, PyTorch and Tianshou. Writes ../../fixtures/ppo.safetensors.

    python -m venv venv && venv/bin/pip install -r requirements.txt && venv/bin/python make.py
"""
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file
from tianshou.data import Batch, ReplayBuffer
from tianshou.policy import BasePolicy, PPOPolicy
from tianshou.utils import RunningMeanStd
from torch.distributions import Categorical, Independent, Normal, kl_divergence

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
    (policy + c1 * vf - c2 * entropy + w * prior).backward(retain_graph=True)
    if trunk is None:
        # The penalty on the means alone.
        mean_only = policy + c1 * vf - c2 * entropy + w * 0.5 * mu.pow(2).mean()
        for (key, _), g in zip(net.named_parameters(), torch.autograd.grad(mean_only, net.parameters())):
            put(f"{name}.grad_mean/{key}", g)
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
    return net


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


def buffer_of(terminated, truncated, obs, after, reward):
    """One environment's steps in Tianshou's buffer, and the batch of all of them."""
    buffer = ReplayBuffer(len(reward))
    for t in range(len(reward)):
        step = dict(obs=obs[t], act=0, rew=reward[t], terminated=terminated[t], truncated=truncated[t], obs_next=after[t], info={})
        buffer.add(Batch(**step))
    return buffer, *buffer.sample(0)


def tianshou_gae(steps=4, gamma=0.93, lam=0.8):
    """Tianshou's own advantages for every pattern of nothing, a termination and a truncation over the steps: an environment each."""
    envs = 3**steps
    ends = np.arange(envs)[None] // 3 ** np.arange(steps)[:, None] % 3
    terminated, truncated = ends == 1, ends == 2
    reward, value, after = rng.normal(size=(3, steps, envs))
    adv, ret = np.zeros((2, steps, envs))
    for i in range(envs):
        buffer, batch, indices = buffer_of(terminated[:, i], truncated[:, i], value[:, i], after[:, i], reward[:, i])
        returns, advantage = BasePolicy.compute_episodic_return(
            batch, buffer, indices, after[:, i], value[:, i], gamma=gamma, gae_lambda=lam
        )
        adv[:, i], ret[:, i] = advantage, returns
    named = dict(reward=reward, value=value, next_value=after, terminated=terminated, truncated=truncated, advantage=adv, returns=ret)
    for name, v in named.items():
        put(f"tianshou.gae.{name}", v)


class Identity(torch.nn.Module):
    """A critic whose value is the observation, so that values can be chosen."""

    def forward(self, obs, **_):
        return torch.as_tensor(obs, dtype=torch.float32)


def ppo_policy(actor, critic, dist, **options):
    params = [p for p in actor.parameters()] or [torch.nn.Parameter(torch.zeros(1))]
    return PPOPolicy(actor, critic, torch.optim.SGD(params, lr=0.0), dist, **options)


def tianshou_returns(steps=12, collections=3, gamma=0.9, lam=0.7):
    """Returns and advantages with Tianshou's reward_normalization over consecutive collections of one environment."""
    options = dict(discount_factor=gamma, gae_lambda=lam, reward_normalization=True)
    policy = ppo_policy(Identity(), Identity(), None, **options)
    for c in range(collections):
        reward = 4 * rng.normal(size=steps) + 1
        value, after = rng.normal(size=(2, steps)).astype(np.float32)
        end = rng.random(steps)
        terminated, truncated = end < 0.15, (end >= 0.15) & (end < 0.3)
        buffer, batch, indices = buffer_of(terminated, truncated, value, after, reward)
        batch = policy._compute_returns(batch, buffer, indices)
        named = dict(reward=reward, value=value, next_value=after, terminated=terminated, truncated=truncated)
        for name, v in (named | dict(advantage=batch.adv, returns=batch.returns)).items():
            put(f"tianshou.returns.{c}.{name}", v)


class Half(torch.nn.Module):
    """Actor or critic of a network, as Tianshou calls them."""

    def __init__(self, net, part):
        super().__init__()
        self.net, self.part = net, part

    def forward(self, obs, state=None, info=None):
        return self.part(self.net, obs) if state is None and info is None else (self.part(self.net, obs), state)


def tianshou_learn(name, net, actor, critic, dist, obs, action, variants, noise=0.9):
    """Losses and gradients of one minibatch through PPOPolicy.learn. `actor` gives the arguments of `dist`."""
    rows = len(obs)
    with torch.no_grad():
        pi = dist(*actor(net, obs))
        old = pi.log_prob(action) + noise * torch.randn(rows)
        old_value = critic(net, obs) + 0.4 * torch.randn(rows)
    adv, ret = torch.randn(rows) * 3 + 1, torch.randn(rows)
    for key, v in dict(obs=obs, action=action, old=old, old_value=old_value, advantage=adv, returns=ret).items():
        put(f"{name}.{key}", v)
    figures = {}
    for variant, options in variants.items():
        policy = ppo_policy(Half(net, actor), Half(net, critic), dist, vf_coef=0.7, ent_coef=0.05, max_grad_norm=None, eps_clip=0.2, **options)
        batch = Batch(obs=obs, act=action, logp_old=old, adv=adv.clone(), returns=ret, v_s=old_value, info=torch.zeros(rows))
        losses = policy.learn(batch, batch_size=rows, repeat=1)
        for key, p in net.named_parameters():
            put(f"{name}.{variant}/{key}", p.grad)
        figures[variant] = np.array([losses["loss/clip"][0], losses["loss/vf"][0], losses["loss/ent"][0]])
        put(f"{name}.figures.{variant}", figures[variant])
    for variant, f in figures.items():
        assert variant == "plain" or not np.allclose(f[:2], figures["plain"][:2], rtol=1e-3), f"{variant} changes nothing"


class Small(torch.nn.Module):
    """Plain layers in the layout of src/agent/spec.rs: one vector of 5 floats."""

    def __init__(self, outputs, hidden=(8, 6), activation=torch.tanh, shared=False, log_std=None):
        super().__init__()
        self.activation = activation

        def layers(width):
            sizes = [width, *hidden]
            return {str(i): torch.nn.Linear(a, b) for i, (a, b) in enumerate(zip(sizes, sizes[1:]))}

        self.shared = torch.nn.ModuleDict(layers(5) if shared else {})
        own = (lambda: {}) if shared else (lambda: layers(5))
        self.actor = torch.nn.ModuleDict(own() | {"out": torch.nn.Linear(hidden[-1], outputs)})
        self.critic = torch.nn.ModuleDict(own() | {"out": torch.nn.Linear(hidden[-1], 1)})
        if log_std is not None:
            self.actor.register_parameter("log_std", torch.nn.Parameter(torch.full((outputs,), log_std)))

    def run(self, head, h):
        for name in self.shared:
            h = self.activation(self.shared[name](h))
        for name in head:
            h = head[name](h) if name == "out" else self.activation(head[name](h))
        return h


def small(name, net, dist, action):
    """A small network through Tianshou; `dist` makes the distribution from (network, actor's output)."""
    for key, p in net.named_parameters():
        put(f"{name}.param/{key}", p)
    actor = lambda net, obs: (net.run(net.actor, obs),)
    critic = lambda net, obs: net.run(net.critic, obs)[:, 0]
    tianshou_learn(name, net, actor, critic, lambda out: dist(net, out), torch.randn(13, 5), action, VARIANTS)


def distributions(rows=7, dims=5):
    """Log densities, entropies and divergences as torch.distributions has them."""
    mu, logvar, action = torch.randn(rows, dims), 0.7 * torch.randn(rows, dims), 2 * torch.randn(rows, dims)
    each = Normal(mu, (logvar / 2).exp())
    pi, prior = Independent(each, 1), Independent(Normal(torch.zeros_like(mu), torch.ones_like(mu)), 1)
    choice = torch.arange(rows) % dims
    softmax = Categorical(logits=mu)
    named = dict(mu=mu, logvar=logvar, action=action, log_prob=pi.log_prob(action), entropy=pi.entropy(), kl=kl_divergence(pi, prior))
    named |= dict(choice=choice, choice_log_prob=softmax.log_prob(choice), choice_entropy=softmax.entropy())
    for key, v in named.items():
        put(f"dist.{key}", v)


def orthogonal(draws=4000, rows=6, columns=9):
    """Mean, variance and fourth moment of the entries of torch's orthogonal weights, and the mean of their diagonal."""
    w = torch.stack([torch.nn.init.orthogonal_(torch.empty(rows, columns), 2**0.5) for _ in range(draws)])
    put("orthogonal.moments", [w.mean(), w.pow(2).mean(), w.pow(4).mean(), w.diagonal(dim1=1, dim2=2).mean()])


def observations():
    """Batches through Tianshou's running mean and standard deviation, then rows normalised, far ones among them."""
    rms, scale = RunningMeanStd(), np.array([1, 20, 0.1, 3, 1])
    for i, rows in enumerate([4, 1, 9]):
        batch = (rng.normal(size=(rows, 5)) * scale + [0, 50, -1, i, 0]).astype(np.float32)
        rms.update(batch)
        put(f"obs.{i}", batch)
    probe = (rng.normal(size=(6, 5)) * scale * 8).astype(np.float32)
    put("obs.probe", probe)
    put("obs.normalised", rms.norm(probe))


VARIANTS = {
    "plain": {},
    "dual": dict(dual_clip=1.3),
    "value": dict(value_clip=True),
    "raw": dict(dual_clip=1.3, value_clip=True, advantage_normalization=False),
}
gaussian = lambda mu, sigma: Independent(Normal(mu, sigma), 1)

gae()
paper = loss("sum", None)
loss("project", 10)
adam()
tianshou_gae()
tianshou_returns()
std = lambda net, obs: (net(obs)[0], (net(obs)[1] / 2).exp())
value = lambda net, obs: net(obs)[2]
tianshou_learn("paper", paper, std, value, gaussian, torch.randn(13, 30), torch.randn(13, 4), VARIANTS)
free = lambda net, mu: gaussian(mu, net.actor.log_std.exp().expand_as(mu))
small("free", Small(3, log_std=-0.5), free, torch.randn(13, 3))
choices = lambda net, logits: Categorical(logits=logits)
small("choice", Small(4, activation=torch.relu, shared=True), choices, torch.randint(4, (13,)))
distributions()
orthogonal()
observations()
save_file(OUT, Path(__file__).parents[2] / "fixtures" / "ppo.safetensors")
