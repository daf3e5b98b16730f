"""Writes tests/fixtures/scenes/penetration.json: how much of posed bodies lies within what stands in two rooms, after Open3D.

Bodies are skinned by NumPy (tests/tools/body/lbs_reference.py); a vertex is inside a room's boxes where Open3D says so of one of their
closed meshes, and as deep as the nearest triangle of any is far. Feet do not count. The others weigh as docs/src/concepts/environment.md
says: head with neck and eyes 5,023 vertices of SMPL-X, hands 2 x 778, all else 3,394.

Run from the repository root: python tests/tools/scenes/penetration.py
"""
import json
import math
import sys
from pathlib import Path

import numpy as np
import open3d as o3d

sys.path.insert(0, "tests/tools/body")
from lbs_reference import pose_body, read, rodrigues  # noqa: E402

FRAMES = 20
# Nothing below is an obstacle: there it is as it is here.
LOWEST = 0.03
rng = np.random.default_rng(11)
body = read("checkpoints/body/body.safetensors")


def num(x):
    return float(f"{x:.7g}")


def weights():
    part = body["part"].astype(int)
    weight = np.where(np.isin(part, [12, 15, 22, 23]), 5023.0, np.where(np.isin(part, [20, 21]), 1556.0, 3394.0))
    foot = np.zeros(len(part), bool)
    foot[body["foot_vertices"]] = True
    region = weight.copy()
    for total in np.unique(region):
        weight[region == total] = total / np.sum((region == total) & ~foot)
    weight[foot] = 0
    return weight


def box(centre, size, yaw):
    mesh = o3d.geometry.TriangleMesh.create_box(*size)
    mesh.translate(-np.array(size) / 2)
    mesh.rotate(mesh.get_rotation_matrix_from_xyz((0, 0, yaw)), (0, 0, 0))
    mesh.translate(centre)
    return o3d.t.geometry.TriangleMesh.from_legacy(mesh)


def room(width, depth, furniture):
    """Four walls that do not touch one another, and boxes on the floor."""
    walls = [((0, s * (depth / 2 + 0.1), 1.25), (width, 0.2, 2.5), 0.0) for s in (-1, 1)]
    walls += [((s * (width / 2 + 0.1), 0, 1.25), (0.2, depth, 2.5), 0.0) for s in (-1, 1)]
    return walls + [((x, y, height / 2), (a, b, height), yaw) for x, y, a, b, height, yaw in furniture]


def depths(boxes, points):
    """0 outside."""
    points = points.copy()
    points[:, 2] = np.maximum(points[:, 2], LOWEST)
    points = o3d.core.Tensor(points.astype(np.float32))
    inside, nearest = np.zeros(len(points), bool), np.full(len(points), np.inf)
    for b in boxes:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(box(*b))
        distance = scene.compute_signed_distance(points, nsamples=5).numpy()
        inside |= distance < 0
        nearest = np.minimum(nearest, np.abs(distance))
    return np.where(inside, nearest, 0)


def pose(x, y):
    """An upright body with its arms down, every joint a little off."""
    params = np.zeros(93)
    turns = rng.normal(0, 0.2, (22, 3))
    turns[16, 2] -= 1.1
    turns[17, 2] += 1.1
    # SMPL-X's rest frame has y up: up to z, a turn about it, a lean.
    yaw = rng.uniform(-math.pi, math.pi)
    upright = rodrigues(np.array([0, 0, yaw])) @ rodrigues(np.array([math.pi / 2, 0, 0])) @ rodrigues(rng.normal(0, 0.1, 3))
    angle = math.acos((np.trace(upright) - 1) / 2)
    axis = np.array([upright[2, 1] - upright[1, 2], upright[0, 2] - upright[2, 0], upright[1, 0] - upright[0, 1]])
    turns[0] = axis / np.linalg.norm(axis) * angle
    params[3:69] = turns.ravel()
    params[:3] = x, y, rng.uniform(0.9, 1.0)
    return np.array([num(p) for p in params])


# x, y, sides, height, yaw: a table's top would be a shelf to a scanner as well, so all are solid.
ROOMS = {
    "office": (4.0, 3.0, [(-1.2, 0.6, 1.4, 0.7, 0.75, 0.3), (1.3, -0.8, 0.6, 0.6, 1.9, 0.0), (0.9, 1.0, 0.5, 0.5, 0.45, 0.8)]),
    "hall": (6.0, 5.0, [(-1.5, -1.0, 0.4, 0.4, 2.5, 0.0), (1.5, -1.0, 0.4, 0.4, 2.5, 0.5), (0.0, 1.6, 2.0, 0.5, 0.5, 0.1)]),
}
weight = weights()
out = []
for name, (width, depth, furniture) in ROOMS.items():
    boxes = room(width, depth, furniture)
    # Half of them somewhere, half near furniture.
    places = [rng.uniform(-0.42, 0.42, 2) * (width, depth) for _ in range(FRAMES // 2)]
    places += [np.array(furniture[k % 3][:2]) + rng.uniform(-0.6, 0.6, 2) for k in range(FRAMES // 2)]
    params = [pose(x, y) for x, y in places]
    inside = [depths(boxes, pose_body(body, np.zeros(10), p)[0]) for p in params]
    count = [float(weight @ (d > 0)) for d in inside]
    depth = [float(weight @ d) for d in inside]
    out.append({
        "name": name,
        "boxes": [{"centre": list(c), "size": list(s), "yaw": yaw} for c, s, yaw in boxes],
        "params": [[float(v) for v in p[:69]] for p in params],
        "count": [num(c) for c in count],
        "depth": [num(d) for d in depth],
        # As if the poses were the frames of one primitive.
        "eq8_depth": num(math.exp(-np.mean(depth))),
        "eq8_count": num(math.exp(-np.mean(count) / 10)),
        "eq11": num(max(count)),
    })
    print(name, [round(c) for c in count], [round(d, 2) for d in depth])
path = Path("tests/fixtures/scenes/penetration.json")
path.write_text(json.dumps(out, separators=(",", ":")) + "\n")
print(path, path.stat().st_size, "bytes")
