"""Reference outputs of PyTorch and SciPy for src/kernels: tests/fixtures/{gru,motion_engine}.safetensors.

Usage: python make_fixtures.py FIXTURES_DIR
"""

import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file
from scipy.spatial.transform import Rotation
from torch import nn

HIDDEN, WIDE, LATENT, FRAME, FUTURE = 8, 12, 5, 201, 18
WIDTH, BLOCKS, PASSES, CONTINUOUS = 16, 2, 3, 159


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
        self.drnn_mlp = Mlp([HIDDEN, WIDE, HIDDEN, HIDDEN], torch.tanh)
        self.d_rnn = nn.GRUCell(HIDDEN + LATENT + FRAME, HIDDEN)
        self.d_mlp = Mlp([HIDDEN, WIDE, HIDDEN], torch.tanh)
        self.d_out = nn.Linear(HIDDEN, FRAME)

    def forward(self, seed, latent):
        h_x = self.x_enc(seed.transpose(0, 1))[1][0]
        h, frame, frames = self.drnn_mlp(h_x), seed[:, -1], []
        for _ in range(FUTURE):
            h = self.d_rnn(torch.cat([h_x, latent, frame], -1), h)
            frame = frame + self.d_out(self.d_mlp(h))
            frames.append(frame)
        return torch.stack(frames, 1)


class Regressor(nn.Module):
    def __init__(self):
        super().__init__()
        self.in_fc = nn.Linear(FRAME + 10 + CONTINUOUS, WIDTH)
        self.layers = nn.ModuleList(Mlp([WIDTH] * 3, torch.relu) for _ in range(BLOCKS))
        self.out_fc = nn.Linear(WIDTH, CONTINUOUS)

    def forward(self, markers, betas):
        body = torch.zeros(len(markers), CONTINUOUS)
        for _ in range(PASSES):
            h = self.in_fc(torch.cat([markers, betas, body], -1))
            for block in self.layers:
                h = block(h) + h
            body = body + self.out_fc(h)
        return body


def to_params(body):
    six = body[:, 3:135].reshape(-1, 3, 2).astype(np.float64)
    x = six[..., 0] / np.linalg.norm(six[..., 0], axis=-1, keepdims=True)
    y = six[..., 1] - x * np.sum(x * six[..., 1], -1, keepdims=True)
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    turns = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], -1)).as_rotvec().reshape(len(body), 66)
    return np.concatenate([body[:, :3], turns, body[:, 135:]], -1).astype(np.float32)


def numpy(tensors):
    return {k: np.ascontiguousarray(v.detach().numpy()) for k, v in tensors.items()}


def main(folder):
    torch.manual_seed(1)
    gru, x = nn.GRU(21, 18, batch_first=True), torch.randn(5, 3, 21)
    save_file(numpy({k[:-3]: v for k, v in gru.state_dict().items()} | {"x": x, "y": gru(x)[0]}), folder / "gru.safetensors")

    predictor, regressor = Predictor(), Regressor()
    seed, latent = torch.randn(3, 2, FRAME), torch.randn(3, LATENT)
    markers, betas = torch.randn(4, FRAME), torch.randn(4, 10)
    weights = predictor.state_dict() | {f"pnet.{k}": v for k, v in regressor.state_dict().items()}
    data = {"seed": seed, "latent": latent, "markers": markers, "betas": betas, "decoded": predictor(seed, latent)}
    tensors = numpy(weights | data)
    tensors["params"] = to_params(regressor(markers, betas).detach().numpy())
    save_file(tensors, folder / "motion_engine.safetensors")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
