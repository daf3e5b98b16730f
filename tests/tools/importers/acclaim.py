"""Makes a tiny synthetic Acclaim skeleton with motion, and the joints an independent NumPy/SciPy reader finds in them.

    python acclaim.py cmu_skeleton.json ../../fixtures/importers

No motion capture goes in: all numbers are random. The reader here shares nothing with the Rust one: it reads the files again,
turns through SciPy's Euler angles (lower-case letters: fixed axes) and chains rotation matrices.
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

# Name of the bone that starts in each joint of the CMU skeleton, with its degrees of freedom; ends have none.
BONES = [
    ("root", ""), ("lhipjoint", ""), ("lfemur", "xyz"), ("ltibia", "x"), ("lfoot", "xz"), ("ltoes", "x"), None,
    ("rhipjoint", ""), ("rfemur", "xyz"), ("rtibia", "x"), ("rfoot", "xz"), ("rtoes", "x"), None,
    ("lowerback", "xyz"), ("upperback", "xyz"), ("thorax", "zyx"), ("lowerneck", "xyz"), ("upperneck", "xyz"), ("head", "xyz"), None,
    ("lclavicle", "yz"), ("lhumerus", "xyz"), ("lradius", "x"), ("lwrist", "y"), ("lhand", "xz"), ("lfingers", "x"), None,
    ("lthumb", "xz"), None,
    ("rclavicle", "yz"), ("rhumerus", "xyz"), ("rradius", "x"), ("rwrist", "y"), ("rhand", "xz"), ("rfingers", "x"), None,
    ("rthumb", "xz"), None,
]  # fmt: skip
LIMBS = {2, 3, 8, 9, 21, 22, 30, 31}
SCALE = 1.25


def write_skeleton(parents, common, path, rng):
    """A larger person with a wider stance and hanging arms."""
    offsets = common * SCALE
    for j in (3, 4, 9, 10):
        offsets[j] += rng.normal(0, 1, 3)
    for j in (22, 23, 31, 32):
        offsets[j] = [0, -np.linalg.norm(offsets[j]), 0]
    lines = ["# synthetic", ":version 1.10", ":units", "  mass 1.0", "  length 0.45", "  angle deg", ":documentation", "   none"]
    lines += [":root", "   order TX TY TZ RX RY RZ", "   axis XYZ", "   position 0 0 0", "   orientation 0 0 0", ":bonedata"]
    children = {}
    for j, bone in enumerate(BONES):
        if bone is None or j == 0:
            continue
        name, dof = bone
        tip = next((c for c in range(38) if parents[c] == j), None)
        offset = offsets[tip] if tip is not None else np.ones(3)
        length = np.linalg.norm(offset)
        direction = offset / length if length > 0 else np.array([1.0, 0, 0])
        axis = np.round(rng.uniform(-180, 180, 3), 3) if dof else np.zeros(3)
        order = ["XYZ", "ZYX", "YZX"][j % 3]
        lines += ["  begin", f"     id {j}", f"     name {name}"]
        lines += ["     direction " + " ".join(f"{v:.8f}" for v in direction), f"     length {length:.8f}"]
        lines += ["     axis " + " ".join(f"{v:.3f}" for v in axis) + "  " + order]
        if dof:
            lines += ["    dof " + " ".join("r" + a for a in dof), "    limits (-160.0 20.0)"] + ["           (-70.0 70.0)"] * (len(dof) - 1)
        lines += ["  end"]
        p = parents[j]
        children.setdefault(BONES[p][0], []).append(name)
    lines += [":hierarchy", "  begin"]
    lines += [f"    {parent} " + " ".join(names) for parent, names in children.items()]
    path.write_text("\r\n".join(lines + ["  end"]) + "\r\n")


def write_motion(frames, path, header, unit):
    lines = ["#!OML:ASF synthetic", *header]
    for t, frame in enumerate(frames):
        lines.append(str(t + 1))
        for name, values in frame.items():
            angles = values[-3:] if name == "root" else values
            place = values[:-3] if name == "root" else []
            lines.append(" ".join([name, *(f"{v:.4f}" for v in place), *(f"{v * unit:.7f}" for v in angles)]))
    path.write_text("\n".join(lines) + "\n")


def read_skeleton(path):
    bones, parents, section, bone = {"root": {"turn": Rotation.identity(), "dof": "xyz"}}, {}, "", {}
    for words in (line.split() for line in path.read_text().splitlines()):
        if words[0].startswith(":"):
            section = words[0]
        elif section == ":bonedata":
            if words[0] == "begin":
                bone = {"dof": ""}
            elif words[0] == "name":
                bones[words[1]] = bone
            elif words[0] == "direction":
                bone["direction"] = np.array([float(v) for v in words[1:]])
            elif words[0] == "length":
                bone["length"] = float(words[1])
            elif words[0] == "axis":
                of = dict(zip("XYZ", map(float, words[1:4])))
                bone["turn"] = Rotation.from_euler(words[4].lower(), [of[a] for a in words[4]], degrees=True)
            elif words[0] == "dof":
                bone["dof"] = "".join(w[1] for w in words[1:])
        elif section == ":hierarchy" and words[0] not in ("begin", "end"):
            parents.update({child: words[0] for child in words[1:]})
    return bones, parents


def read_frames(path):
    frames = []
    for words in (line.split() for line in path.read_text().splitlines() if line[0] not in "#:"):
        if len(words) == 1:
            frames.append({})
        else:
            frames[-1][words[0]] = np.array([float(v) for v in words[1:]])
    return frames


def joints(parents, common, bones, bone_parents, frame, unit):
    """Joints on the common skeleton with limbs that point where the file has them."""
    world = {}
    for name, bone in bones.items():
        angles = frame["root"][3:] if name == "root" else frame.get(name, [])
        local = Rotation.from_euler(bone["dof"], angles, degrees=True) if len(angles) else Rotation.identity()
        local = bone["turn"] * local * bone["turn"].inv()
        world[name] = local if name == "root" else world[bone_parents[name]] * local
    bone_of = [b[0] if b else BONES[parents[j]][0] for j, b in enumerate(BONES)]
    leg = sum(np.linalg.norm(common[j]) for j in (3, 4))
    pos = [frame["root"][:3] * unit * leg / sum(bones[b]["length"] for b in ("lfemur", "ltibia"))]
    for j in range(1, 38):
        p = parents[j]
        rest = common[j]
        if p in LIMBS:
            rest = bones[bone_of[p]]["direction"] * np.linalg.norm(rest)
        elif 23 <= p <= 28 or p >= 32:  # Hands hang with the arms.
            rest = Rotation.from_euler("z", -90 if p < 30 else 90, degrees=True).apply(rest)
        pos.append(pos[p] + world[bone_of[p]].apply(rest * unit))
    return pos


def main():
    skeleton, out = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    parents, common = skeleton["parents"], np.array(skeleton["offsets"])
    rng = np.random.default_rng(11)
    write_skeleton(parents, common, out / "small.asf", rng)
    moving = [b for b in BONES[1:] if b and b[1]]
    frames = [{"root": rng.uniform(-60, 60, 6), **{n: rng.uniform(-60, 60, len(d)) for n, d in moving}} for _ in range(3)]
    write_motion(frames, out / "small.amc", [":FULLY-SPECIFIED", ":DEGREES"], 1)
    write_motion(frames, out / "radians.amc", [":FULLY-SPECIFIED", ":RADIANS", ":SAMPLES-PER-SECOND 60"], np.pi / 180)
    bones, bone_parents = read_skeleton(out / "small.asf")
    found = [joints(parents, common, bones, bone_parents, f, skeleton["unit_m"]) for f in read_frames(out / "small.amc")]
    (out / "acclaim_joints.json").write_text(json.dumps(np.round(found, 6).tolist()))


if __name__ == "__main__":
    main()
