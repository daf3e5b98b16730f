"""Writes rooms.json and furnished.json to tests/fixtures/scenes: signed distances at random voxels of a procedural room, and of a floor with
furniture of others on it, by Open3D and summed-up solid angles.

Run from the repository root: python tests/tools/scenes/rooms.py [--archive scenes.tar.gz] [--bundle DIR]. The furniture needs the archive.
With a bundle, such as one of `scene room --kind furnished --seed 4 --difficulty 0.3 --voxel 0 --pairs-count 0`, its mesh becomes room.ply first.
"""
import argparse
import json
import struct
import tarfile
import tempfile
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh

OUT = Path("tests/fixtures/scenes")
FLOOR, ABOVE, MARGIN = 0.02, 0.03, 0.2
# File, metres per unit, turn about z, place.
PIECES = [
    ("sweethome3d_cc0/sofa/sofa.obj", 0.01, 0.3, (-1.2, 0.8)),
    ("sweethome3d_cc0/desk/desk.obj", 0.01, -1.1, (1.1, 0.6)),
    ("polyhaven_drake/wooden_bookshelf_worn_1k.gltf", 1.0, 2.0, (0.4, -1.3)),
]
FREE = [(-2.5, -2.5, 1.0), (2.5, 2.5, 1.0), (-2.5, 2.5, 1.0)]


def of_bundle(folder):
    data = (folder / "scene.safetensors").read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    part = lambda name, kind: np.frombuffer(data[slice(*(8 + size + o for o in header[name]["data_offsets"]))], kind).reshape(-1, 3)
    vertices, triangles = part("vertices", "<f4"), part("triangles", "<i4")
    text = f"ply\nformat binary_little_endian 1.0\ncomment a procedural room\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
    text += f"property float z\nelement face {len(triangles)}\nproperty list uchar ushort vertex_indices\nend_header\n"
    assert len(vertices) < 65536
    body = vertices.tobytes() + b"".join(struct.pack("<B3H", 3, *t) for t in triangles)
    (OUT / "room.ply").write_bytes(text.encode() + body)


def winding(triangles, points):
    """Generalised winding numbers, every solid angle summed up in double precision."""
    total = np.zeros(len(points))
    for part in np.array_split(triangles, len(triangles) // 2000 + 1):
        a, b, c = (part[None, :, k] - points[:, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
        dot = lambda u, v: np.einsum("ijk,ijk->ij", u, v)
        above = dot(a, np.cross(b, c))
        below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        total += 2 * np.arctan2(above, below).sum(1) / (4 * np.pi)
    return total


def distances(triangles, voxel, count, free, among=lambda points: np.arange(len(points))):
    """Signed distances at random ones of the voxels that `among` tells."""
    low, high = triangles.reshape(-1, 3).min(0) - MARGIN, triangles.reshape(-1, 3).max(0) + MARGIN
    dims = np.ceil((high - low) / voxel - 1e-4).astype(int) + 1
    rng = np.random.default_rng(5)
    all = np.stack(np.unravel_index(np.arange(dims.prod()), dims), 1) * voxel + low
    numbers = np.sort(rng.choice(among(all), count, replace=False))
    points = all[numbers]
    # Triangles on the floor are no obstacles, and beneath the floor the scene goes on as just above it.
    points[:, 2] = np.maximum(points[:, 2], ABOVE)
    obstacles = triangles[~(np.abs(triangles[:, :, 2]) <= FLOOR).all(1)]
    scene = o3d.t.geometry.RaycastingScene()
    order = np.arange(3 * len(obstacles), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor(obstacles.reshape(-1, 3).astype(np.float32)), o3d.core.Tensor(order))
    distance = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    outside = np.median(winding(triangles, np.array(free, float))) if free else 0.0
    inside = np.abs(winding(triangles, points) - outside)
    # Where it is a matter of rounding nothing is said.
    clear = np.abs(inside - 0.5) > 0.05
    print(f"{len(triangles)} triangles, voxels {dims}, {(inside > 0.5).sum()} of {clear.sum()} inside, free {outside:.3f}")
    return {
        "lowest": [round(float(v), 6) for v in low],
        "voxel": voxel,
        "dims": dims.tolist(),
        "numbers": numbers[clear].tolist(),
        "values": [round(float(v), 6) for v in np.where(inside > 0.5, -distance, distance)[clear]],
        "free": free,
    }


def furnished(archive):
    half = 3.0
    sheet = np.array([[[-half, -half, 0], [half, -half, 0], [half, half, 0]], [[-half, -half, 0], [half, half, 0], [-half, half, 0]]])
    all, pieces, boxes = [sheet], [], []
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(archive) as tar:
            tar.extractall(folder, filter="data")
        for file, unit, yaw, (x, y) in PIECES:
            loaded = trimesh.load(Path(folder) / "scenes" / file, process=False, maintain_order=True)
            meshes = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
            t = np.concatenate([m.triangles for m in meshes if isinstance(m, trimesh.Trimesh)]) * unit
            area = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1) / 2
            t = t[area >= 1e-12]
            # y up becomes z up; then it is turned and put on the floor.
            t = np.stack([t[..., 0], -t[..., 2], t[..., 1]], -1)
            lift = -t[..., 2].min()
            turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
            t = t @ turn.T + (x, y, lift)
            boxes.append((t.reshape(-1, 3).min(0) - 0.1, t.reshape(-1, 3).max(0) + 0.1))
            all.append(t)
            pieces.append({"file": file, "yaw": yaw, "at": [x, y, round(float(lift), 7)]})
    near = lambda points: np.flatnonzero(np.any([((points > low) & (points < high)).all(1) for low, high in boxes], 0))
    return {"pieces": pieces, **distances(np.concatenate(all), 0.05, 500, FREE, near)}


parser = argparse.ArgumentParser()
parser.add_argument("--archive", type=Path)
parser.add_argument("--bundle", type=Path)
args = parser.parse_args()
if args.bundle:
    of_bundle(args.bundle)
write = lambda name, fixture: (OUT / name).write_text(json.dumps(fixture, separators=(",", ":")) + "\n")
mesh = o3d.io.read_triangle_mesh(str(OUT / "room.ply"))
write("rooms.json", distances(np.asarray(mesh.vertices)[np.asarray(mesh.triangles)], 0.08, 500, []))
if args.archive and args.archive.is_file():
    write("furnished.json", furnished(args.archive))
else:
    print("furniture left as it is: no archive given")
