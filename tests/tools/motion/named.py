"""Makes a tiny synthetic BVH file of the ReActIdle rig and where its limbs and axes point by an independent NumPy/SciPy reader.

    python named.py ../../fixtures/motion

No motion capture goes in: all numbers are random. World directions have z up: (x, y, z) of the file becomes (x, -z, y).
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

# Joint, parent, rest offset.
RIG = [
    ("pelvis", None, (0, 0.7, 0)), ("spine", "pelvis", (0, 0, 0)), ("spine.001", "spine", (0, 0.2, 0.01)),
    ("neck", "spine.001", (0, 0.2, -0.02)), ("face", "neck", (0, 0.16, 0)),
    ("shoulder.L", "spine.001", (0, 0.2, -0.02)), ("upper_arm.L", "shoulder.L", (0.14, 0, 0)), ("forearm.L", "upper_arm.L", (0.22, -0.05, 0.01)),
    ("shoulder.R", "spine.001", (0, 0.2, -0.02)), ("upper_arm.R", "shoulder.R", (-0.14, 0, 0)), ("forearm.R", "upper_arm.R", (-0.21, 0.04, 0)),
    ("pelvis.L", "pelvis", (0, 0, 0)), ("pelvis.R", "pelvis", (0, 0, 0)),
    ("thigh.L", "pelvis", (0.09, 0, 0)), ("shin.L", "thigh.L", (0.02, -0.36, 0.03)), ("foot.L", "shin.L", (0.016, -0.31, 0)),
    ("thigh.R", "pelvis", (-0.09, 0, 0)), ("shin.R", "thigh.R", (-0.02, -0.37, 0)), ("foot.R", "shin.R", (-0.016, -0.3, 0.02)),
]  # fmt: skip
LIMBS = ["shin.L", "shin.R", "foot.L", "foot.R", "forearm.L", "forearm.R"]
AXES = ["pelvis", "spine.001", "neck", "face"]


def write(path, rng):
    """Every other joint has channels of place too, and turns in another order."""
    parents = {name: parent for name, parent, _ in RIG}
    orders = {name: ["XYZ", "YXZ"][i % 2] for i, (name, _, _) in enumerate(RIG)}
    lines = ["HIERARCHY"]

    def joint(name, offset, depth):
        pad = "  " * depth
        lines.extend([pad + ("ROOT " if depth == 0 else "JOINT ") + name, pad + "{", pad + "  OFFSET %f %f %f" % offset])
        place = "6 Xposition Yposition Zposition" if orders[name] == "XYZ" else "3"
        lines.append(f"{pad}  CHANNELS {place} " + " ".join(a + "rotation" for a in orders[name]))
        children = [(n, o) for n, p, o in RIG if p == name]
        for child, o in children:
            joint(child, o, depth + 1)
        if not children:
            lines.extend([pad + "  End Site", pad + "  {", pad + "    OFFSET 0.0 0.1 0.0", pad + "  }"])
        lines.append(pad + "}")

    joint("pelvis", RIG[0][2], 0)
    # The hierarchy is written depth first.
    order = [line.split()[1] for line in lines if line.split()[0] in ("ROOT", "JOINT")]
    offsets = {name: np.array(offset) for name, _, offset in RIG}
    lines += ["MOTION", "Frames: 3", "Frame Time: 0.041667"]
    frames = []
    for _ in range(3):
        row, turned, frame = [], {}, {}
        for name in order:
            angles = np.round(rng.uniform(-50, 50, 3), 4)
            if orders[name] == "XYZ":
                place = np.round(rng.normal(0, 0.1, 3), 4) if name == "pelvis" else offsets[name]
                row.extend(place)
                if name == "pelvis":
                    frame["root"] = place + offsets[name]
            row.extend(angles)
            # Capital letters: each turn about the axes as the ones before left them.
            local = Rotation.from_euler(orders[name], angles, degrees=True)
            turned[name] = local if parents[name] is None else turned[parents[name]] * local
        up = Rotation.from_euler("x", 90, degrees=True)
        for name in LIMBS:
            way = offsets[name] / np.linalg.norm(offsets[name])
            frame[name] = (up * turned[parents[name]]).apply(way).tolist()
        for name in AXES:
            frame[name] = (up * turned[name]).apply(np.eye(3)).ravel().tolist()
        frame["root"] = up.apply(frame["root"]).tolist()
        lines.append(" ".join(f"{v:.6f}" for v in row))
        frames.append({k: np.round(v, 6).tolist() for k, v in frame.items()})
    (path / "named.bvh").write_text("\n".join(lines) + "\n")
    (path / "named_directions.json").write_text(json.dumps(frames))


write(Path(sys.argv[1]), np.random.default_rng(3))
