"""Makes tiny synthetic CMU files and the joints an independent NumPy/SciPy reader finds in them.

    python make_fixtures.py cmu_skeleton.json ../../fixtures/motion

No motion capture goes in: all numbers are random. The readers here share nothing with the Rust ones; rotations go
through SciPy and joints are chained as row vectors, G_j = R(e_j) G_parent, p_j = offset_j G_parent + p_parent.
"""

import json
import sys

import numpy as np
from scipy.spatial.transform import Rotation

CHANNELS = ["Zrotation Yrotation Xrotation", "Zrotation Xrotation Yrotation"]


def chain(parents, offsets, root, local_rows):
    """Joint positions; local_rows[j] acts on row vectors."""
    glob, pos = [], []
    for j, parent in enumerate(parents):
        if parent < 0:
            glob.append(local_rows[j])
            pos.append(root)
        else:
            glob.append(local_rows[j] @ glob[parent])
            pos.append(offsets[j] @ glob[parent] + pos[parent])
    return np.array(pos)


def row_rotation(expmap):
    """Rodrigues' matrix of e, used on row vectors as it is."""
    angle = np.linalg.norm(expmap)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = expmap / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def expmap_file(skeleton, out, rng):
    parents, offsets = skeleton["parents"], np.array(skeleton["offsets"])
    unit = skeleton["unit_m"]
    rows = rng.normal(0, 0.6, (4, 117))
    rows[0, 3:] = 0
    rows[:, :3] *= 20
    rows = np.round(rows, 6)
    with open(out / "expmap.txt", "w") as f:
        f.writelines(",".join(f"{v:.6f}" for v in row) + "\n" for row in rows)
    joints = [chain(parents, offsets * unit, row[:3] * unit, [row_rotation(e) for e in row[3:].reshape(38, 3)]) for row in rows[1:]]
    (out / "expmap_joints.json").write_text(json.dumps(np.round(joints, 6).tolist()))


def bvh_file(skeleton, out, rng):
    """The file rests with hanging arms and is larger; the expected joints are those of the common skeleton."""
    parents, common = skeleton["parents"], np.array(skeleton["offsets"])
    scale = 1.25
    offsets = common * scale
    arms = {}
    for first, hand in ((21, 23), (30, 32)):
        for j in (first + 1, first + 2):
            offsets[j] = [0, -np.linalg.norm(offsets[j]), 0]
            arms[j - 1] = common[j]
    children = {j: [c for c in range(38) if parents[c] == j] for j in range(38)}
    order = {j: CHANNELS[j % 2] for j in range(38) if children[j]}
    lines = ["HIERARCHY"]

    def write(j, depth):
        pad = "\t" * depth
        head = "ROOT Hips" if j == 0 else (f"JOINT j{j}" if children[j] else "End Site")
        lines.extend([pad + head, pad + "{", f"{pad}\tOFFSET " + " ".join(f"{v:.6f}" for v in offsets[j])])
        if children[j]:
            lead = "6 Xposition Yposition Zposition" if j == 0 else "3"
            lines.append(f"{pad}\tCHANNELS {lead} {order[j]}")
        for c in children[j]:
            write(c, depth + 1)
        lines.append(pad + "}")

    write(0, 0)
    frames = np.round(rng.uniform(-60, 60, (3, 3 + 3 * len(order))), 4)
    lines += ["MOTION", f"Frames: {len(frames)}", "Frame Time: .0083333"]
    lines += [" ".join(f"{v:.4f}" for v in row) for row in frames]
    (out / "small.bvh").write_text("\r\n".join(lines) + "\r\n")

    unit, joints = skeleton["unit_m"], []
    for row in frames:
        glob, pos, angles = [], [], iter(row[3:].reshape(-1, 3))
        for j, parent in enumerate(parents):
            local = Rotation.identity()
            if j in order:
                axes = "".join(word[0] for word in order[j].split())
                local = Rotation.from_euler(axes, next(angles), degrees=True)
            glob.append(local if parent < 0 else glob[parent] * local)
        # Limbs point where the file has them, with the common skeleton's lengths.
        for j, parent in enumerate(parents):
            if parent < 0:
                pos.append(row[:3] * unit / scale)
                continue
            hanging = parent in arms or (parent >= 23 and parent <= 28) or parent >= 32
            rest = common[j]
            if hanging:
                side = 1 if parent < 30 else -1
                rest = Rotation.from_euler("z", -90 * side, degrees=True).apply(rest)
            pos.append(pos[parent] + glob[parent].apply(rest * unit))
        joints.append(pos)
    (out / "bvh_joints.json").write_text(json.dumps(np.round(joints, 6).tolist()))


def main():
    from pathlib import Path

    skeleton = json.loads(Path(sys.argv[1]).read_text())
    out = Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)
    expmap_file(skeleton, out, rng)
    bvh_file(skeleton, out, rng)


if __name__ == "__main__":
    main()
