"""Writes tests/fixtures/scenes: small meshes in every format and what trimesh or Open3D reads of them, and signed distances by Open3D.

Run from the repository root: python tests/tools/scenes/meshes.py [scenes.tar.gz]. With the archive of furniture, what trimesh reads of
some pieces is written too.
"""
import base64
import json
import pickle
import struct
import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh
from scipy.ndimage import map_coordinates

OUT = Path("tests/fixtures/scenes")
PIECES = [
    "sweethome3d_cc0/sofa/sofa.obj",
    "sweethome3d_cc0/bookcase/bookcase.obj",
    "sweethome3d_cc0/oakChair/oakChair.obj",
    "sweethome3d_cc0/desk/desk.obj",
    "sweethome3d_cc0/L_shaped_sofa/L_shaped_sofa.obj",
    "kaykit_furniture/armchair_pillows.gltf",
    "kaykit_furniture/shelf_A_big.gltf",
    "polyhaven_drake/sofa_03_1k.gltf",
    "polyhaven_drake/wooden_bookshelf_worn_1k.gltf",
]


def num(x):
    return float(f"{x:.7g}")


def nums(a):
    return [num(x) for x in np.asarray(a).ravel()]


def hand_made():
    (OUT / "table.mtl").write_text("newmtl oak\nKd 0.6 0.4 0.2\nd 0.5\nnewmtl steel\nKd 0.5 0.5 0.6\nTr 0.25\n")
    # A top of five corners, faces that count back, a broken line, a triangle without area, a vertex that nothing uses.
    (OUT / "table.obj").write_text(
        "# a table in centimetres\nmtllib table.mtl\no top\nv -60 70 -40\nv -60 70 40\nv 60 70 40\nv 75 70 0 1.0\nv 60 70 -40 0.1 0.2 0.3\n"
        "vt 0 0\nvn 0 1 0\nusemtl oak\nf 1/1/1 2/1/1 3/1/1 4/1/1 5/1/1\ng leg\nusemtl steel\nv 999 999 999\nv 0 0 0\nv 5 0 0\nv 5 70 0\nv 0 70 0\n"
        "f -4//1 -3//1 \\\n -2//1 -1//1\nf 7 8 7\no top\nusemtl none\nf 7 9 1\n"
    )
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]], "<f4")
    indices = np.array([0, 2, 1, 0, 3, 2, 0, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4], "<u2")
    (OUT / "tree.bin").write_bytes(positions.tobytes() + indices.tobytes())
    other = np.array([[0, 0, 0], [2, 0, 0], [0, 0, -2]], "<f4").tobytes()
    accessor = lambda view, kind, shape, count, **more: {"bufferView": view, "componentType": kind, "type": shape, "count": count, **more}
    limits = {"min": [0, 0, 0], "max": [1, 1, 1]}
    document = {
        "asset": {"version": "2.0"},
        "scene": 1,
        "scenes": [{"nodes": [3]}, {"nodes": [0, 3]}],
        "nodes": [
            {"name": "root", "translation": [1, 2, 3], "rotation": [0, 0.7071067811865476, 0, 0.7071067811865476], "children": [1, 2]},
            {"name": "pyramid", "mesh": 0, "scale": [2, 2, 2]},
            {"name": "mirrored", "mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
            {"mesh": 1},
        ],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]},
            {"name": "sail", "primitives": [{"attributes": {"POSITION": 2}}]},
        ],
        "materials": [{"name": "brass", "pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.6, 0.2, 1]}}],
        "accessors": [
            accessor(0, 5126, "VEC3", 5, **limits),
            accessor(1, 5123, "SCALAR", 18),
            accessor(2, 5126, "VEC3", 3, min=[0, 0, -2], max=[2, 0, 0]),
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 60},
            {"buffer": 0, "byteOffset": 60, "byteLength": 36},
            {"buffer": 1, "byteLength": 36},
        ],
        "buffers": [
            {"byteLength": 96, "uri": "tree.bin"},
            {"byteLength": 36, "uri": "data:application/octet-stream;base64," + base64.b64encode(other).decode()},
        ],
    }
    (OUT / "tree.gltf").write_text(json.dumps(document, indent=1) + "\n")


def big_endian(path, vertices, faces):
    """A PLY with double coordinates, colours and faces of any number of corners, high bytes first."""
    header = (
        f"ply\nformat binary_big_endian 1.0\ncomment by hand\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"property uchar red\nelement face {len(faces)}\nproperty list uchar int vertex_index\nproperty short flags\nend_header\n"
    )
    body = b"".join(struct.pack(">dddB", *v, 200) for v in vertices)
    body += b"".join(struct.pack(f">B{len(f)}ih", len(f), *f, 7) for f in faces)
    path.write_bytes(header.encode() + body)


def exported():
    """Files as trimesh and Open3D write them."""
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.icosphere(subdivisions=1, radius=0.5), transform=trimesh.transformations.translation_matrix([0, 1, 0]))
    scene.add_geometry(trimesh.creation.box([1, 0.5, 0.25]), transform=trimesh.transformations.rotation_matrix(0.5, [0, 1, 0]))
    (OUT / "scene.glb").write_bytes(scene.export(file_type="glb"))
    torus = trimesh.creation.torus(0.8, 0.3, major_sections=14, minor_sections=10)
    torus.apply_transform(trimesh.transformations.rotation_matrix(0.4, [1, 2, 3]))
    (OUT / "torus.ply").write_bytes(torus.export(file_type="ply"))
    mesh = o3d.geometry.TriangleMesh.create_cylinder(0.4, 1.0, 8, 2)
    o3d.io.write_triangle_mesh(str(OUT / "cylinder.ply"), mesh, write_ascii=True, write_vertex_normals=False)
    big_endian(OUT / "wedge.ply", [(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0), (0, 0, 1), (0, 1, 1)], [(3, 2, 1, 0), (0, 1, 4), (2, 3, 5), (1, 2, 5, 4), (3, 0, 4, 5)])
    # Open at its bottom: a box and half a sphere, as furniture is that stands on the floor.
    box = trimesh.creation.box([1.0, 0.8, 0.6])
    box.update_faces(box.face_normals[:, 2] > -0.5)
    angles = np.linspace(0, np.pi / 2, 9)
    ball = trimesh.creation.revolve(0.4 * np.stack([np.cos(angles), np.sin(angles)], 1), sections=16)
    if (ball.face_normals * ball.triangles_center).sum() < 0:
        ball.invert()
    ball.apply_translation([1.4, 0, -0.3])
    (OUT / "open.ply").write_bytes(trimesh.util.concatenate([box, ball]).export(file_type="ply"))


def corners(path):
    """All triangles of a file (n, 3, 3), by Open3D for PLY, which knows polygons, and by trimesh for the others."""
    if path.suffix == ".ply":
        mesh = o3d.io.read_triangle_mesh(str(path))
        return np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    loaded = trimesh.load(path, process=False, maintain_order=True)
    meshes = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    return np.concatenate([m.triangles for m in meshes if isinstance(m, trimesh.Trimesh)])


def read(path):
    """What others read: places of vertices that triangles use, triangles with an area, bounds, area, volume, in the file's units."""
    triangles = corners(path)
    good = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1) / 2
    kept = triangles[good > 0]
    return {
        "triangles": len(kept),
        "bounds": [nums(kept.reshape(-1, 3).min(0)), nums(kept.reshape(-1, 3).max(0))],
        "area": num(good.sum()),
        "volume": num(np.einsum("ij,ij->i", kept[:, 0], np.cross(kept[:, 1], kept[:, 2])).sum() / 6),
        "places": len(np.unique(np.round(kept.reshape(-1, 3), 3), axis=0)),
    }


def winding(triangles, points):
    """Generalised winding numbers, every solid angle summed up in double precision."""
    a, b, c = (triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    dot = lambda u, v: np.einsum("ijk,ijk->ij", u, v)
    above = dot(a, np.cross(b, c))
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return 2 * np.arctan2(above, below).sum(1) / (4 * np.pi)


def distances(name, lowest, voxel, dims, closed):
    triangles = corners(OUT / name)
    scene = o3d.t.geometry.RaycastingScene()
    numbers = np.arange(3 * len(triangles), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor(triangles.reshape(-1, 3).astype(np.float32)), o3d.core.Tensor(numbers))
    grid = np.stack(np.meshgrid(*(np.arange(d) for d in dims), indexing="ij"), -1) * voxel + np.asarray(lowest)
    points = grid.reshape(-1, 3)
    inside = winding(triangles, points)
    if closed:
        values = scene.compute_signed_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
        assert ((values < 0) == (inside > 0.5)).all()
    else:
        values = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    return {"file": name, "lowest": nums(lowest), "voxel": voxel, "dims": list(dims), "values": [round(float(v), 6) for v in values], "winding": [round(float(w), 4) for w in inside]}


def authors():
    """A grid in the authors' layout, and what their look-up says: grid_sample with border padding and align_corners = False."""
    rng = np.random.default_rng(3)
    n, center, scale = 6, np.array([0.5, -1.0, 1.25], np.float32), np.float32(0.4)
    sdf = rng.normal(size=(n, n, n)).astype(np.float32)
    with open(OUT / "authors.pkl", "wb") as f:
        pickle.dump({"center": center, "scale": float(scale), "sdf": sdf}, f, protocol=4)
    np.savez(OUT / "authors.npz", center=center[None].astype(np.float64), scale=np.array([scale]), sdf=sdf[None, None])
    points = np.round(rng.uniform([-1.9, -3.4, -1.2], [2.9, 1.4, 3.7], (40, 3)), 3)
    steps = (((points - center) * scale + 1) * n - 1) / 2
    values = -map_coordinates(sdf.astype(float), np.clip(steps, 0, n - 1).T, order=1, mode="nearest")
    held = ((steps >= 0) & (steps <= n - 1)).all(1)
    return {"points": nums(points[held]), "values": nums(values[held])}


def furniture(archive):
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(archive) as tar:
            tar.extractall(folder, filter="data")
        pieces = {piece: read(Path(folder) / "scenes" / piece) for piece in PIECES}
    (OUT / "furniture.json").write_text(json.dumps(pieces, indent=1) + "\n")


OUT.mkdir(parents=True, exist_ok=True)
hand_made()
exported()
names = ["table.obj", "tree.gltf", "scene.glb", "torus.ply", "cylinder.ply", "wedge.ply", "open.ply"]
(OUT / "meshes.json").write_text(json.dumps({name: read(OUT / name) for name in names}, indent=1) + "\n")
grids = [
    distances("torus.ply", (-1.5, -1.4, -1.2), 0.3, (11, 10, 9), True),
    distances("wedge.ply", (-0.43, -0.43, -0.43), 0.25, (13, 9, 9), True),
    distances("open.ply", (-0.7, -0.6, -0.42), 0.15, (19, 9, 8), False),
]
(OUT / "distances.json").write_text(json.dumps({"grids": grids, "authors": authors()}) + "\n")
if len(sys.argv) > 1 and Path(sys.argv[1]).is_file():
    furniture(sys.argv[1])
else:
    print("furniture left as it is: no archive given")
