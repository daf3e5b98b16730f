"""Reference outputs of PyTorch for src/motion/pose_prior.rs: tests/fixtures/vposer_{v1,v2}.safetensors.

The modules are written after the published descriptions of VPoser v1 and v2, in evaluation mode, at reduced width.
Usage: python make.py FIXTURES_DIR
"""

import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import nn
from torch.nn import functional as F

POSE, WIDE, LATENT = 63, 10, 32


class V1(nn.Module):
    def __init__(self):
        super().__init__()
        self.bodyprior_enc_bn1 = nn.BatchNorm1d(POSE)
        self.bodyprior_enc_fc1 = nn.Linear(POSE, WIDE)
        self.bodyprior_enc_bn2 = nn.BatchNorm1d(WIDE)
        self.bodyprior_enc_fc2 = nn.Linear(WIDE, WIDE)
        self.bodyprior_enc_mu = nn.Linear(WIDE, LATENT)
        self.bodyprior_enc_logvar = nn.Linear(WIDE, LATENT)
        self.bodyprior_dec_fc1 = nn.Linear(LATENT, WIDE)
        self.bodyprior_dec_fc2 = nn.Linear(WIDE, WIDE)
        self.bodyprior_dec_out = nn.Linear(WIDE, 2 * POSE)

    def encode(self, x):
        x = F.leaky_relu(self.bodyprior_enc_fc1(self.bodyprior_enc_bn1(x)), 0.2)
        x = F.leaky_relu(self.bodyprior_enc_fc2(self.bodyprior_enc_bn2(x)), 0.2)
        return self.bodyprior_enc_mu(x)

    def decode(self, z):
        x = F.leaky_relu(self.bodyprior_dec_fc1(z), 0.2)
        x = F.leaky_relu(self.bodyprior_dec_fc2(x), 0.2)
        return self.bodyprior_dec_out(x)


class Normal(nn.Module):
    def __init__(self):
        super().__init__()
        self.mu = nn.Linear(WIDE, LATENT)
        self.logvar = nn.Linear(WIDE, LATENT)

    def forward(self, x):
        return self.mu(x)


class V2(nn.Module):
    def __init__(self):
        super().__init__()
        self.encoder_net = nn.Sequential(
            nn.Flatten(), nn.BatchNorm1d(POSE), nn.Linear(POSE, WIDE), nn.LeakyReLU(), nn.BatchNorm1d(WIDE), nn.Dropout(0.1),
            nn.Linear(WIDE, WIDE), nn.Linear(WIDE, WIDE), Normal(),
        )  # fmt: skip
        self.decoder_net = nn.Sequential(
            nn.Linear(LATENT, WIDE), nn.LeakyReLU(), nn.Dropout(0.1), nn.Linear(WIDE, WIDE), nn.LeakyReLU(), nn.Linear(WIDE, 2 * POSE)
        )

    def encode(self, x):
        return self.encoder_net(x)

    def decode(self, z):
        return self.decoder_net(z)


def main():
    out = Path(sys.argv[1])
    for name, make, prefix in [("v1", V1, ""), ("v2", V2, "vp_model.")]:
        torch.manual_seed(3)
        model = make().eval()
        for m in model.modules():
            if isinstance(m, nn.BatchNorm1d):
                n = m.num_features
                m.running_mean.copy_(torch.randn(n))
                m.running_var.copy_(torch.rand(n) + 0.1)
                with torch.no_grad():
                    m.weight.copy_(torch.rand(n) + 0.5)
                    m.bias.copy_(torch.randn(n))
        poses, latents = torch.randn(4, POSE), torch.randn(4, LATENT)
        with torch.no_grad():
            results = {"poses": poses, "latents": latents, "mu": model.encode(poses), "rotations": model.decode(latents)}
        weights = {prefix + k: v for k, v in model.state_dict().items() if v.is_floating_point()}
        save_file({k: v.contiguous() for k, v in (weights | results).items()}, out / f"vposer_{name}.safetensors")


if __name__ == "__main__":
    main()
