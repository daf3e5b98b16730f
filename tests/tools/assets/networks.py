"""Checkpoints in the layouts in which the authors publish theirs, at reduced width, and what PyTorch computes with them.

Writes vposer_v1.pt (the stream layout that PyTorch had before 1.6), vposer_v2.ckpt, predictor.ckp, regressor.ckp, policy.pth and, with
all inputs and outputs, expected.safetensors. The modules are written after the descriptions of the published ones.
Usage: python networks.py FIXTURES_DIR (the folder `assets` within is written)
"""

import re
import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import nn

sys.path.insert(0, str(Path(__file__).parents[1] / "pose_prior"))
import make as vposer  # noqa: E402

MARKERS, BETAS, BODY = 201, 10, 159
HIDDEN, WIDE, LATENT = 4, 6, 3
WIDTH, BLOCKS, PASSES = 5, 2, 3
STATES, OCTAVES = 5, 3


class MLP(nn.Module):
    """Every layer, the last included, is followed by the activation."""

    def __init__(self, width, widths, activation):
        super().__init__()
        self.layers = nn.ModuleList()
        self.activation = activation
        for w in widths:
            self.layers.append(nn.Linear(width, w))
            width = w

    def forward(self, x):
        for layer in self.layers:
            x = self.activation(layer(x))
        return x


class Predictor(nn.Module):
    def __init__(self):
        super().__init__()
        self.x_enc = nn.GRU(MARKERS, HIDDEN)
        self.e_rnn = nn.GRU(MARKERS, HIDDEN)
        self.e_mlp = MLP(2 * HIDDEN, [WIDE, HIDDEN], torch.tanh)
        self.e_mu = nn.Linear(HIDDEN, LATENT)
        self.e_logvar = nn.Linear(HIDDEN, LATENT)
        self.drnn_mlp = MLP(HIDDEN, [WIDE, HIDDEN, HIDDEN], torch.tanh)
        self.d_rnn = nn.GRUCell(MARKERS + LATENT + HIDDEN, HIDDEN)
        self.d_mlp = MLP(HIDDEN, [WIDE, HIDDEN], torch.tanh)
        self.d_out = nn.Linear(HIDDEN, MARKERS)

    def encode(self, x, y):
        h = self.e_mlp(torch.cat([self.x_enc(x)[1][0], self.e_rnn(y)[1][0]], -1))
        return self.e_mu(h), self.e_logvar(h)

    def decode(self, x, z, steps):
        hx = self.x_enc(x)[1][0]
        h, frame, frames = self.drnn_mlp(hx), x[-1], []
        for _ in range(steps):
            h = self.d_rnn(torch.cat([hx, z, frame], -1), h)
            frame = frame + self.d_out(self.d_mlp(h))
            frames.append(frame)
        return torch.stack(frames)


class Residual(nn.Module):
    def __init__(self, width, out, blocks, activation):
        super().__init__()
        self.layers = nn.ModuleList([MLP(width, [width, width], activation) for _ in range(blocks)])
        self.out_fc = nn.Linear(width, out)

    def forward(self, h):
        for layer in self.layers:
            h = layer(h) + h
        return self.out_fc(h)


class ResNet(Residual):
    def __init__(self):
        super().__init__(WIDTH, BODY, BLOCKS, torch.relu)
        self.in_fc = nn.Linear(MARKERS + BODY + BETAS, WIDTH)

    def forward(self, x):
        return super().forward(self.in_fc(x))


class Regressor(nn.Module):
    def __init__(self):
        super().__init__()
        self.pnet = ResNet()

    def forward(self, markers, betas):
        body = torch.zeros(len(markers), BODY)
        for _ in range(PASSES):
            body = self.pnet(torch.cat([markers, body, betas], -1)) + body
        return body


class Shared(nn.Module):
    def __init__(self):
        super().__init__()
        self.x_enc = nn.GRU(2 * MARKERS, STATES)
        self.ego_enc = nn.GRU(32, STATES)

    def forward(self, state, ego, scalars):
        parts = [self.x_enc(state)[1][0], self.ego_enc(ego)[1][0]]
        for x in scalars:
            parts += [f(x * 2.0**k) for k in range(OCTAVES) for f in (torch.sin, torch.cos)]
        return torch.cat(parts, -1)


class Head(nn.Module):
    def __init__(self, name, out):
        super().__init__()
        width = 2 * STATES + 4 * OCTAVES
        setattr(self, name, Residual(width, out, BLOCKS, nn.LeakyReLU()))


class Policy(nn.Module):
    """The combined module of PPO appears again under another name, with the same storages."""

    def __init__(self):
        super().__init__()
        self.actor, self.critic, self.shared_net = Head("pnet", 2 * LATENT), Head("vnet", 1), Shared()
        self._actor_critic = nn.ModuleDict({"actor": self.actor, "critic": self.critic, "shared_net": self.shared_net})

    def forward(self, *obs):
        trunk = self.shared_net(*obs)
        mu, logvar = self.actor.pnet(trunk).chunk(2, -1)
        return mu, logvar.clamp(-2.5, 2.5), self.critic.vnet(trunk)


def optimiser(model, parameter):
    """State of Adam after one update of one parameter: as nested as that of all, and smaller."""
    adam = torch.optim.Adam(model.parameters(), lr=0.0)
    parameter.grad = torch.ones_like(parameter)
    adam.step()
    parameter.grad = None
    return adam.state_dict()


def save_stream(state, path):
    """The layout before PyTorch 1.6 names storages by their addresses; one storage with a fixed name makes the file the same every time."""
    flat, views, at = torch.cat([v.flatten() for v in state.values()]), {}, 0
    for name, v in state.items():
        views[name] = flat[at : at + v.numel()].view(v.shape)
        at += v.numel()
    torch.save(views, path, _use_new_zipfile_serialization=False)
    key = b"94000000000000"
    fixed = b"X" + len(key).to_bytes(4, "little") + key
    path.write_bytes(re.sub(rb"X[\x0d-\x0f]\0\0\0\d{13,15}", fixed, path.read_bytes()))


def save_vposer(out, expected):
    for name, make in [("v1", vposer.V1), ("v2", vposer.V2)]:
        torch.manual_seed(4)
        model = make().eval()
        for m in model.modules():
            if isinstance(m, nn.BatchNorm1d):
                m.running_mean.copy_(torch.randn(m.num_features))
                m.running_var.copy_(torch.rand(m.num_features) + 0.1)
        poses, latents = torch.randn(4, vposer.POSE), torch.randn(4, vposer.LATENT)
        expected |= {f"{name}.poses": poses, f"{name}.latents": latents}
        expected |= {f"{name}.mu": model.encode(poses), f"{name}.rotations": model.decode(latents)}
        if name == "v1":
            save_stream({k: v for k, v in model.state_dict().items() if v.is_floating_point()}, out / "vposer_v1.pt")
        else:
            state = {f"vp_model.{k}": v for k, v in model.state_dict().items()}
            state["bm_train.init_betas"] = torch.zeros(1, 10)
            extras = {"epoch": 13, "global_step": 7, "pytorch-lightning_version": "1.1.5", "hyper_parameters": {"lr": 1e-3, "bm": None}}
            extras |= {"optimizer_states": [optimiser(model, model.decoder_net[5].bias)], "callbacks": {"wait": 0, "best": torch.tensor(0.03)}}
            torch.save({"state_dict": state} | extras, out / "vposer_v2.ckpt")


def save_motion(out, expected):
    torch.manual_seed(5)
    model = Predictor()
    seed, future, latent = torch.randn(2, 3, MARKERS), torch.randn(18, 3, MARKERS), torch.randn(3, LATENT)
    mu, logvar = model.encode(seed, future)
    decoded = model.decode(seed, latent, 18)
    # Person outermost, as ours.
    rows = {"seed": seed.transpose(0, 1), "future": future.transpose(0, 1), "decoded": decoded.transpose(0, 1)}
    expected |= {f"predictor.{k}": v for k, v in (rows | {"latent": latent, "mu": mu, "logvar": logvar}).items()}
    adam = optimiser(model, model.e_mu.bias)
    torch.save({"epoch": 400, "model_state_dict": model.state_dict(), "optimizer_state_dict": adam}, out / "predictor.ckp")
    model = Regressor()
    markers, betas = torch.randn(4, MARKERS), torch.randn(4, BETAS)
    expected |= {"regressor.markers": markers, "regressor.betas": betas, "regressor.body": model(markers, betas)}
    adam = optimiser(model, model.pnet.out_fc.bias)
    torch.save({"epoch": 100, "model_state_dict": model.state_dict(), "optimizer_state_dict": adam}, out / "regressor.ckp")


def save_policy(out, expected):
    torch.manual_seed(6)
    model = Policy()
    with torch.no_grad():
        model.actor.pnet.out_fc.weight *= 8
    n = 3
    state, ego, dist, time = torch.randn(2, n, 2 * MARKERS), torch.rand(2, n, 32) * 2 - 1, torch.rand(n, 1), torch.rand(n, 1)
    mu, logvar, value = model(state, ego, [dist, time])
    assert (logvar.abs() == 2.5).any() and (logvar.abs() < 2.5).any(), "the clamp is not tested"
    flat = [x.transpose(0, 1).reshape(n, -1) for x in (state, ego)] + [dist, time]
    expected |= {"policy.obs": torch.cat(flat, 1), "policy.mu": mu, "policy.logvar": logvar, "policy.value": value[:, 0]}
    adam = optimiser(model, model.actor.pnet.out_fc.bias)
    torch.save({"model": model.state_dict(), "optim": adam}, out / "policy.pth")


def main():
    out = Path(sys.argv[1]) / "assets"
    out.mkdir(parents=True, exist_ok=True)
    expected = {}
    for save in (save_vposer, save_motion, save_policy):
        save(out, expected)
    save_file({k: v.detach().contiguous() for k, v in expected.items()}, out / "expected.safetensors")
    (out / "expected.safetensors").chmod(0o644)


if __name__ == "__main__":
    main()
