#!/usr/bin/env python3
"""Reference skinning of the compact body, in plain NumPy and double precision.

Written apart from the product's code: it reads checkpoints/body/body.safetensors with its
own small reader, poses four bodies and writes tests/fixtures/body_lbs.safetensors, which
the tests compare the product with.

    python tests/tools/body/lbs_reference.py

A pose is 93 numbers: translation 3, global orientation 3 (axis-angle), body pose 21 x 3
(axis-angle), hands 24 (this body has no finger joints: ignored). The pelvis turns about
its own joint:  v = sum_k w_k (R_k (v - J_k) + x_k) + translation.
"""

import argparse
import json
import os
import struct

import numpy as np

DTYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I32": "<i4", "U16": "<u2", "U8": "u1"}


def read(path):
    """All tensors of a safetensors file."""
    with open(path, "rb") as f:
        size = struct.unpack("<Q", f.read(8))[0]
        header = json.loads(f.read(size))
        data = f.read()
    out = {}
    for name, e in header.items():
        if name != "__metadata__":
            a, b = e["data_offsets"]
            out[name] = np.frombuffer(data[a:b], DTYPES[e["dtype"]]).reshape(e["shape"])
    return out


def write(path, tensors):
    """Writes tensors as a safetensors file, replacing it in one step."""
    names = {np.dtype(v): k for k, v in DTYPES.items()}
    header, blob = {}, b""
    for name, t in tensors.items():
        raw = np.ascontiguousarray(t).tobytes()
        header[name] = {"dtype": names[t.dtype], "shape": list(t.shape),
                        "data_offsets": [len(blob), len(blob) + len(raw)]}
        blob += raw
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    with open(path + ".part", "wb") as f:
        f.write(struct.pack("<Q", len(text)) + text + blob)
    os.replace(path + ".part", path)


def rodrigues(r):
    """Rotation matrix of an axis-angle vector."""
    angle = np.sqrt(r @ r)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = r / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def pose_body(body, betas, params):
    """Vertices (V, 3) and joints (24, 3) of a posed body."""
    betas, params = betas.astype(np.float64), params.astype(np.float64)
    rest = body["v_template"].astype(np.float64) + body["shapedirs"].astype(np.float64) @ betas
    joint = (body["joints_template"].astype(np.float64)
             + body["joint_dirs"].astype(np.float64) @ betas)
    # The reader widens the half-precision weights and makes their sum 1 again.
    w = body["skin_weight"].astype(np.float64)
    w = w / w.sum(axis=1, keepdims=True)

    local = [rodrigues(params[3 + 3 * k:6 + 3 * k]) for k in range(22)]
    local += [np.eye(3), np.eye(3)]  # the eyes follow the head
    rot, pos = [], []
    for k, parent in enumerate(body["parents"]):
        if parent < 0:
            rot.append(local[k])
            pos.append(joint[k])
        else:
            rot.append(rot[parent] @ local[k])
            pos.append(pos[parent] + rot[parent] @ (joint[k] - joint[parent]))

    out = np.zeros_like(rest)
    for v in range(len(rest)):
        for k, weight in zip(body["skin_index"][v], w[v]):
            if weight > 0:
                out[v] += weight * (rot[k] @ (rest[v] - joint[k]) + pos[k])
    return out + params[:3], np.array(pos) + params[:3]


def cases(rng):
    """Four shapes and poses."""
    betas = np.zeros((4, 10))
    params = np.zeros((4, 93))
    betas[1] = rng.normal(0, 1, 10)
    betas[2] = rng.normal(0, 1, 10)
    betas[3] = [2.5, -2, 2, -1.5, 3, -3, 2, -2, 1.5, -2.5]

    # 1: a natural pose, walking with the arms down, every joint a little off.
    pose = rng.normal(0, 0.08, (22, 3))
    for joint, r in {1: (-0.6, 0, 0), 2: (0.3, 0, 0), 4: (0.8, 0, 0), 5: (0.2, 0, 0),
                     16: (0, 0, -1.2), 17: (0, 0, 1.2), 18: (0, -0.5, 0), 19: (0, 0.4, 0)}.items():
        pose[joint] += r
    pose[0] = (0.05, 0.7, -0.04)
    params[1, 3:69] = pose.ravel()
    params[1, :3] = (1.3, 0.9, -2.1)

    # 2: large rotations up to nearly half a turn, some exactly zero, one tiny.
    pose = rng.normal(0, 1, (22, 3))
    pose /= np.linalg.norm(pose, axis=1, keepdims=True)
    pose *= rng.uniform(1.5, np.pi - 0.02, (22, 1))
    pose[0] *= (np.pi - 1e-4) / np.linalg.norm(pose[0])
    pose[5] *= (np.pi - 1e-3) / np.linalg.norm(pose[5])
    pose[[3, 7, 12, 19]] = 0.0
    pose[9] *= 1e-6
    params[2, 3:69] = pose.ravel()
    params[2, :3] = (-3.2, 0.1, 4.4)

    # 3: a big shape in a seated pose.
    pose = np.zeros((22, 3))
    pose[[1, 2], 0] = -1.5
    pose[[4, 5], 0] = 1.6
    pose[16, 2], pose[17, 2] = -1.1, 1.1
    pose[0] = (0.1, -2.2, 0.05)
    params[3, 3:69] = pose.ravel()
    params[3, :3] = (0.2, -0.4, 0.6)

    params[:, 69:] = rng.normal(0, 0.5, (4, 24))  # hands: must have no effect
    return betas.astype(np.float32), params.astype(np.float32)


def main():
    ap = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    ap.add_argument("--body", default="checkpoints/body/body.safetensors")
    ap.add_argument("--out", default="tests/fixtures/body_lbs.safetensors")
    args = ap.parse_args()

    body = read(args.body)
    rng = np.random.default_rng(20)
    betas, params = cases(rng)
    # 64 vertices: two of every part, the others at random.
    ids = []
    for k in range(24):
        mine = np.flatnonzero(body["part"] == k)
        ids += list(rng.choice(mine, min(2, len(mine)), replace=False))
    others = np.setdiff1d(np.arange(len(body["part"])), ids)
    ids += list(rng.choice(others, 64 - len(ids), replace=False))
    ids = np.sort(np.array(ids)).astype(np.int32)

    joints, markers, vertices, mean = [], [], [], []
    for b, p in zip(betas, params):
        v, x = pose_body(body, b, p)
        joints.append(x)
        markers.append(v[body["markers"]])
        vertices.append(v[ids])
        mean.append(v.mean(axis=0))
    f32 = lambda a: np.array(a).astype(np.float32)
    os.makedirs(os.path.dirname(args.out) or ".", exist_ok=True)
    write(args.out, {
        "betas": betas, "params": params, "joints": f32(joints), "markers": f32(markers),
        "vertex_ids": ids, "vertices": f32(vertices), "vertex_sum": f32(mean),
    })
    print(args.out, "mean vertex of each row:", np.round(mean, 4).tolist())


if __name__ == "__main__":
    main()
