"""Reference outputs of PyTorch for the motion model at reduced width: tests/fixtures/motion_model.safetensors.

The modules carry the authors' names, so the file's weights are a state dict in their layout.
Usage: python make_model.py FIXTURES_DIR
"""

import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file
from torch import nn

FRAME, HIDDEN, WIDE, LATENT, FUTURE = 9, 8, 12, 5, 6
MARKERS, WIDTH, BLOCKS, PASSES, CONTINUOUS = 201, 6, 2, 3, 159


class Mlp(nn.Module):
    """Every layer, the last included, is followed by the activation."""

    def __init__(self, sizes, activation):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        self.activation = activation

    def forward(self, x):
        for layer in self.layers:
            x = self.activation(layer(x))
        return x


class Predictor(nn.Module):
    def __init__(self):
        super().__init__()
        self.x_enc = nn.GRU(FRAME, HIDDEN)
        self.e_rnn = nn.GRU(FRAME, HIDDEN)
        self.e_mlp = Mlp([2 * HIDDEN, WIDE, HIDDEN], torch.tanh)
        self.e_mu = nn.Linear(HIDDEN, LATENT)
        self.e_logvar = nn.Linear(HIDDEN, LATENT)
        self.drnn_mlp = Mlp([HIDDEN, WIDE, HIDDEN, HIDDEN], torch.tanh)
        self.d_rnn = nn.GRUCell(HIDDEN + LATENT + FRAME, HIDDEN)
        self.d_mlp = Mlp([HIDDEN, WIDE, HIDDEN], torch.tanh)
        self.d_out = nn.Linear(HIDDEN, FRAME)

    def encode(self, seed, future):
        h_x = self.x_enc(seed.transpose(0, 1))[1][0]
        h_y = self.e_rnn(future.transpose(0, 1))[1][0]
        h = self.e_mlp(torch.cat([h_x, h_y], -1))
        return self.e_mu(h), self.e_logvar(h)

    def decode(self, seed, latent):
        h_x = self.x_enc(seed.transpose(0, 1))[1][0]
        h, frame, frames = self.drnn_mlp(h_x), seed[:, -1], []
        for _ in range(FUTURE):
            h = self.d_rnn(torch.cat([h_x, latent, frame], -1), h)
            frame = frame + self.d_out(self.d_mlp(h))
            frames.append(frame)
        return torch.stack(frames, 1)


class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.in_fc = nn.Linear(MARKERS + 10 + CONTINUOUS, WIDTH)
        self.layers = nn.ModuleList(Mlp([WIDTH] * 3, torch.relu) for _ in range(BLOCKS))
        self.out_fc = nn.Linear(WIDTH, CONTINUOUS)

    def forward(self, x):
        h = self.in_fc(x)
        for block in self.layers:
            h = block(h) + h
        return self.out_fc(h)


class Regressor(nn.Module):
    def __init__(self):
        super().__init__()
        self.pnet = Net()

    def forward(self, markers, betas):
        body = torch.zeros(len(markers), CONTINUOUS)
        for _ in range(PASSES):
            body = body + self.pnet(torch.cat([markers, betas, body], -1))
        return body


def main(out):
    torch.manual_seed(0)
    predictor, regressor = Predictor(), Regressor()
    seed, future, latent = torch.randn(3, 2, FRAME), torch.randn(3, FUTURE, FRAME), torch.randn(3, LATENT)
    markers, betas = torch.randn(4, MARKERS), torch.randn(4, 10)
    mu, logvar = predictor.encode(seed, future)
    values = dict(predictor.state_dict(), **regressor.state_dict())
    values.update(seed=seed, future=future, latent=latent, mu=mu, logvar=logvar, decoded=predictor.decode(seed, latent))
    values.update(markers=markers, betas=betas, body=regressor(markers, betas))
    arrays = {k: np.ascontiguousarray(v.detach().numpy()) for k, v in values.items()}
    save_file(arrays, Path(out) / "motion_model.safetensors")


if __name__ == "__main__":
    main(sys.argv[1])
