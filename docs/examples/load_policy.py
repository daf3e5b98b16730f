"""A policy bundle in PyTorch, and whether it says what its golden pair says. Usage: load_policy.py DIR"""
import json, sys
import torch
from safetensors.torch import load_file

def load(folder):
    """The description, and a function from observations (n, D) to mu (n, A), logvar (n, A) and value (n)."""
    d = json.load(open(f"{folder}/policy.json"))
    w = {name: t.float() for name, t in load_file(f"{folder}/policy.safetensors").items()}
    p = d["policy"]
    assert not (p.get("hidden") or p.get("obs_norm") or p.get("log_std")), "not a network of the paper's form"
    linear = lambda name, x: torch.nn.functional.linear(x, w[f"{name}.weight"], w[f"{name}.bias"])
    leaky = lambda x: torch.nn.functional.leaky_relu(x, 0.01)

    def encode(group, x):
        name, shape = group["name"], group["shape"]
        if shape == [1]:  # a scalar: sin, then cos, of 2^k x
            angles = x * 2.0 ** torch.arange(p["octaves"])
            return torch.cat([angles.sin(), angles.cos()], 1)
        if len(shape) == 1:
            return x
        gru = torch.nn.GRU(shape[1], p["gru"][name], batch_first=True)
        gru.load_state_dict({key: w[f"encoder.{name}.{key}"] for key in gru.state_dict()})
        return gru(x.view(-1, *shape))[1][0]

    def head(name, h):
        for b in range(p["blocks"]):
            h = leaky(linear(f"{name}.{b}.1", leaky(linear(f"{name}.{b}.0", h)))) + h
        return linear(f"{name}.out", h)

    @torch.no_grad()
    def policy(obs):
        groups = d["layout"]["groups"]
        parts = obs.split([torch.Size(g["shape"]).numel() for g in groups], 1)
        h = torch.cat([encode(g, x) for g, x in zip(groups, parts)], 1)
        h = linear("project", h) if p.get("trunk") else h
        mu, logvar = head("actor", h).chunk(2, 1)
        return mu, logvar.clamp(*p["logvar"]), head("critic", h)[:, 0]

    return d, policy

def error(folder):
    """The largest difference from the golden pair."""
    d, policy = load(folder)
    golden = {name: torch.tensor(values) for name, values in d["golden"].items()}
    said = policy(golden["obs"][None])
    return max((x[0] - golden[name]).abs().max().item() for name, x in zip(["mu", "logvar", "value"], said))

if __name__ == "__main__":
    off = error(sys.argv[1])
    sys.exit(f"off by {off}" if not off <= 1e-4 else print(f"reproduced within {off:.1e}"))
