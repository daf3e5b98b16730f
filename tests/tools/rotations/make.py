"""Writes tests/fixtures/rotations.safetensors: rotation conversions by SciPy and a Gram-Schmidt by NumPy's QR."""
import pathlib
import numpy as np
from safetensors.numpy import save_file
from scipy.spatial.transform import Rotation

rng = np.random.default_rng(7)
v = rng.normal(size=(40, 3))
v *= (rng.uniform(0, np.pi - 1e-3, 40) / np.linalg.norm(v, axis=1))[:, None]
edges = [[0, 0, 0], [1e-8, 0, 0], [0, -1e-5, 2e-5], [1e-3, 2e-3, -1e-3], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi]]
diagonal = np.array([[1, 1, 0], [-1, 2, 0.5], [0.3, -0.2, -1]])
edges += list(diagonal / np.linalg.norm(diagonal, axis=1)[:, None] * np.pi)
edges += [[0, np.pi - 1e-4, 0], [np.pi / 2, 0, 0], [0, 0, -np.pi / 2]]
rotvec = np.concatenate([v, np.array(edges)]).astype(np.float32)
matrix = Rotation.from_rotvec(rotvec.astype(np.float64)).as_matrix()

six = rng.normal(size=(len(rotvec), 6))
six_matrix = []
for d in six:
    a = d.reshape(3, 2)
    q, r = np.linalg.qr(a)
    q = q * np.sign(np.diag(r))
    six_matrix.append(np.stack([q[:, 0], q[:, 1], np.cross(q[:, 0], q[:, 1])], axis=1))

out = pathlib.Path(__file__).resolve().parents[2] / "fixtures" / "rotations.safetensors"
f = lambda x: np.ascontiguousarray(x, dtype=np.float32)
save_file({"rotvec": f(rotvec), "matrix": f(matrix), "six": f(six), "six_matrix": f(six_matrix)}, out)
