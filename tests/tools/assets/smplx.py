"""A body file in the layout of SMPLX_NEUTRAL.npz with few vertices and made-up content, and what PyTorch's skinning makes of it.

Writes smplx.npz and smplx_expected.safetensors. The forward pass is written after the published description of SMPL-X: shape, joints of
the shaped body, pose correctives, linear blend skinning, hands of twelve components about the mean hand.
Usage: python smplx.py FIXTURES_DIR (the folder `assets` within is written)
"""

import sys
import zipfile
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

V, J, SHAPE, EXPRESSION = 80, 55, 10, 10
BODY = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15]
FINGERS = [parent for wrist in (20, 21) for k in range(5) for parent in (wrist, *(25 + 15 * (wrist - 20) + 3 * k + i for i in (0, 1)))]
PARENTS = BODY + FINGERS


def grid(x, steps):
    """Multiples of 1/steps: exact in half precision, and small when packed."""
    return (np.round(x * steps) / steps).astype(np.float16)


def body(rng):
    weights = np.zeros((V, J))
    for row in weights:
        # Some vertices have more bones than most formats hold.
        bones = rng.choice(J, rng.integers(1, 7), replace=False)
        row[bones] = rng.multinomial(64, np.ones(len(bones)) / len(bones)) / 64
    regressor = np.zeros((J, V))
    for row in regressor:
        row[rng.choice(V, 4, replace=False)] = [0.5, 0.25, 0.125, 0.125]
    sparse = (rng.random((V, 3, 9 * (J - 1))) < 0.04) * rng.normal(size=(V, 3, 9 * (J - 1)))
    hands = {}
    for side in "lr":
        hands[f"hands_mean{side}"] = grid(rng.normal(size=45) * 0.3, 256)
        hands[f"hands_components{side}"] = grid(rng.normal(size=(45, 45)) * 0.2, 32)
    kintree = np.array([PARENTS, range(J)], dtype=np.int64)
    kintree[0, 0] = 2**32 - 1
    return hands | {
        "v_template": grid(rng.normal(size=(V, 3)) * 0.5, 1024).astype(np.float64),
        "f": rng.integers(0, V, (30, 3)).astype(np.uint32),
        "shapedirs": grid(rng.normal(size=(V, 3, SHAPE + EXPRESSION)) * 0.05, 512).astype(np.float64),
        "posedirs": grid(sparse * 0.02, 256),
        "J_regressor": regressor,
        "weights": weights,
        "kintree_table": kintree,
        # Entries that a reader has to pass over.
        "joint2num": np.array({"Pelvis": 0}, dtype=object),
        "dynamic_lmk_faces_idx": np.zeros((3, 2), dtype=np.int32),
    }


def rotation(v):
    return torch.matrix_exp(torch.stack([torch.linalg.cross(v, e.expand_as(v)) for e in torch.eye(3, dtype=v.dtype)], -1))


def forward(b, betas, params):
    t = {k: torch.tensor(v.astype(np.float64)) for k, v in b.items() if v.dtype != object}
    hand = lambda side, x: t[f"hands_mean{side}"] + x @ t[f"hands_components{side}"][:12]  # noqa: E731
    zero = torch.zeros(9, dtype=torch.float64)
    pose = torch.cat([params[3:69], zero, hand("l", params[69:81]), hand("r", params[81:93])]).view(J, 3)
    shaped = t["v_template"] + t["shapedirs"][:, :, :SHAPE] @ betas
    joints = t["J_regressor"] @ shaped
    local = rotation(pose)
    posed = shaped + t["posedirs"] @ (local[1:] - torch.eye(3)).reshape(-1)
    rot, pos = [local[0]], [joints[0]]
    for k in range(1, J):
        p = PARENTS[k]
        pos.append(pos[p] + rot[p] @ (joints[k] - joints[p]))
        rot.append(rot[p] @ local[k])
    rot, pos = torch.stack(rot), torch.stack(pos)
    moved = torch.einsum("jab,vb->vja", rot, posed) + (pos - torch.einsum("jab,jb->ja", rot, joints))
    vertices = torch.einsum("vj,vja->va", t["weights"], moved)
    return vertices + params[:3], pos + params[:3]


def main():
    out = Path(sys.argv[1]) / "assets"
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)
    arrays = body(rng)
    # As numpy.savez_compressed, with a fixed date.
    with zipfile.ZipFile(out / "smplx.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w") as file:
                np.lib.format.write_array(file, array, allow_pickle=True)
    betas, params = torch.tensor(rng.normal(size=(3, 10))), torch.tensor(rng.normal(size=(3, 93)) * 0.5)
    vertices, joints = zip(*(forward(arrays, b, p) for b, p in zip(betas, params)))
    expected = {"betas": betas, "params": params, "vertices": torch.stack(vertices), "joints": torch.stack(joints)}
    save_file({k: v.float().contiguous() for k, v in expected.items()}, out / "smplx_expected.safetensors")
    (out / "smplx_expected.safetensors").chmod(0o644)


if __name__ == "__main__":
    main()
