#!/usr/bin/env python3
"""Writes tests/fixtures/bodies/inside.json: pairs of posed bodies, how many vertices of the first lie inside the second, and signed
distances to the second at some points.

Bodies are skinned by the NumPy reference of tests/tools/body. trimesh takes the second one apart into its closed parts (skin and
eyes); a vertex is inside when Open3D finds it inside any of them. Run from the repository root: python tests/tools/bodies/make.py
"""

import json
import sys
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh

sys.path.insert(0, "tests/tools/body")
from lbs_reference import pose_body, read  # noqa: E402

OUT = Path("tests/fixtures/bodies")
UP = np.array([0.0, 0.70710678, 0.70710678]) * np.pi  # y up, z forward -> z up, +y forward: half a turn about (0, 1, 1)


def num(x):
    return float(f"{x:.7g}")


def standing(x, y, yaw, lean, betas):
    """A person facing +y turned by yaw, arms down and bent, one leg ahead."""
    params = np.zeros(93)
    half = np.concatenate([[np.cos(yaw / 2)], np.sin(yaw / 2) * np.array([0, 0, 1.0])])
    up = np.concatenate([[0.0], UP / np.pi])
    w = half[0] * up[0] - half[1:] @ up[1:]
    v = half[0] * up[1:] + up[0] * half[1:] + np.cross(half[1:], up[1:])
    angle = 2 * np.arctan2(np.linalg.norm(v), w)
    params[3:6] = v / np.linalg.norm(v) * angle
    params[:3] = [x, y, 0.95]
    pose = params[6:69].reshape(21, 3)
    pose[15, 2], pose[16, 2] = -1.2, 1.2
    pose[17, 1], pose[18, 1] = -lean, lean
    pose[0, 0], pose[1, 0], pose[2, 0] = -lean, lean / 2, lean / 3
    return {"params": [num(v) for v in params], "betas": [num(b) for b in betas]}


def skin(body, person):
    vertices, _ = pose_body(body, np.array(person["betas"]), np.array(person["params"]))
    return vertices


def scene_of(mesh):
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return scene


def main():
    body = read("checkpoints/body/body.safetensors")
    faces = body["faces"].astype(np.int64)
    rng = np.random.default_rng(5)
    cases = []
    for x, y, yaw in [(0.1, 0.1, 0.4), (0.25, 0.0, 3.1), (0.0, 0.3, 1.5), (0.45, 0.1, 0.0), (0.9, 0.9, 0.0)]:
        a = standing(x, y, yaw, 0.5, 0.5 * rng.standard_normal(10))
        b = standing(0.0, 0.0, 0.0, 0.3, 0.5 * rng.standard_normal(10))
        va, vb = skin(body, a), skin(body, b)
        whole = trimesh.Trimesh(vb, faces, process=False)
        parts = whole.split(only_watertight=False)
        assert all(p.is_watertight for p in parts), "the body's parts are closed"
        inside = np.zeros(len(va), bool)
        for part in parts:
            # Several rays vote, for one may run along an edge.
            occupied = scene_of(part).compute_occupancy(o3d.core.Tensor(va.astype(np.float32)), nsamples=5).numpy()
            inside |= occupied > 0.5
        skin_part = max(parts, key=lambda p: len(p.faces))
        points = np.array([0.0, 0.0, 0.7]) + rng.uniform(-0.4, 0.4, (12, 3))
        distance = scene_of(skin_part).compute_signed_distance(o3d.core.Tensor(points.astype(np.float32)), nsamples=5).numpy()
        cases.append({"a": a, "b": b, "inside": int(inside.sum()), "points": [[num(v) for v in [*p, d]] for p, d in zip(points, distance)]})
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "inside.json").write_text(json.dumps(cases) + "\n")


if __name__ == "__main__":
    main()
