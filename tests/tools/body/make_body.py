#!/usr/bin/env python3
"""Builds the compact parametric body (checkpoints/body/body.safetensors).

The source is the `anny` package (code Apache-2.0, MakeHuman body data CC0). Ordinary
adults are sampled, every one is brought into the zero pose of SMPL-X, and the result is
reduced to a mean and ten principal directions, with joints linear in the same
coefficients.

Steps, per sampled adult:
 1. rest mesh and bone heads in MakeHuman's A-pose (x left, y up, z forward, metres);
 2. the forearm is twisted along its length so that the palm can face down;
 3. the A-pose is taken back to the zero pose by *inverting* the linear blend skinning of
    the asset itself. Posing the asset back into the A-pose (arms lowered, elbows a little
    bent: close to how people stand and walk) therefore gives MakeHuman's own surface,
    and what linear blending distorts shows up in the T-pose instead.

Run from the repository root:
    python tests/tools/body/make_body.py --out checkpoints/body/body.safetensors
"""

import argparse
import json
import os
import tempfile

import numpy as np
import torch
from safetensors.numpy import save_file
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

# --- the skeleton: 22 body joints of SMPL-X and the two eyes ---------------------------
JOINTS = (
    "pelvis l_hip r_hip spine1 l_knee r_knee spine2 l_ankle r_ankle spine3 l_foot r_foot "
    "neck l_collar r_collar head l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist "
    "l_eye r_eye"
).split()
PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15]
J = {name: i for i, name in enumerate(JOINTS)}
SWAP = [
    J[("r" if n[0] == "l" else "l") + n[1:]] if n[:2] in ("l_", "r_") else i
    for i, n in enumerate(JOINTS)
]

# Bone whose head is the joint centre ({s} = L or R); the foot joint is the mean of the
# toe bases (ball of the foot).
JOINT_BONE = {
    "pelvis": "spine05", "spine1": "spine04", "spine2": "spine03", "spine3": "spine02",
    "neck": "neck01", "head": "head", "hip": "upperleg01.{s}", "knee": "lowerleg01.{s}",
    "ankle": "foot.{s}", "collar": "clavicle.{s}", "shoulder": "upperarm01.{s}",
    "elbow": "lowerarm01.{s}", "wrist": "wrist.{s}", "eye": "eye.{s}",
}
TOE_BASES = ["toe%d-1.{s}" % k for k in range(1, 6)]

# The 67 markers of the SSM2 set, in its order.
SSM2 = (
    "C7 CLAV LANK LFWT LBAK LBCEP LBSH LBUM LBUST LCHEECK LELB LELBIN LFIN LFRM2 LFTHI "
    "LFTHIIN LHEE LIWR LKNE LKNI LMT1 LMT5 LNWST LOWR LBWT LRSTBEEF LSHO LTHI LTHMB LTIB "
    "LTOE MBLLY RANK RFWT RBAK RBCEP RBSH RBUM RBUSTLO RCHEECK RELB RELBIN RFIN RFRM2 "
    "RFRM2IN RFTHI RFTHIIN RHEE RKNE RKNI RMT1 RMT5 RNWST ROWR RBWT RRSTBEEF RSHO RTHI "
    "RTHMB RTIB RTOE STRN T8 LFHD LBHD RFHD RBHD"
).split()

THIGH_OUT = np.deg2rad(2.0)  # the thighs lean outwards a little, the shins are vertical
FOOT_OUT = np.deg2rad(4.0)   # the feet point forward, toes a little out


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def perpendicular(v, axis):
    """The part of v at right angles to the unit vector axis, normalised."""
    return unit(v - np.sum(v * axis, -1, keepdims=True) * axis)


def frame(first, second):
    """Rotations whose columns are first, second (made orthogonal) and their product."""
    a = unit(first)
    b = perpendicular(second, a)
    return np.stack([a, b, np.cross(a, b)], -1)


def align(first, second, to_first, to_second):
    """Rotations taking the directions (first, second) to (to_first, to_second)."""
    to = frame(np.asarray(to_first, float), np.asarray(to_second, float))
    return to @ np.swapaxes(frame(first, second), -1, -2)


def swing(a, b):
    """The smallest rotations taking the directions a to the direction b."""
    a = unit(a)
    axis = np.cross(a, b)
    s = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(s, np.sum(a * b, -1, keepdims=True))
    return Rotation.from_rotvec(axis / np.maximum(s, 1e-12) * angle).as_matrix()


def twist_angle(rot, axis):
    """Angle of the twist about the unit axis when rot = swing * twist."""
    q = Rotation.from_matrix(rot).as_quat()
    t = 2 * np.arctan2(np.sum(q[:, :3] * axis, -1), q[:, 3])
    return (t + np.pi) % (2 * np.pi) - np.pi


# --- sampling ----------------------------------------------------------------------------

def sample_adults(model, n, rng):
    """Blend shape coefficients (n, K) of ordinary adults and their phenotypes."""
    g = rng.beta(1.2, 4.0, n)
    g = np.where(rng.random(n) < 0.5, g, 1 - g)  # 0 male-like, 1 female-like
    normal = lambda mean, sd, lo, hi: np.clip(rng.normal(mean, sd, n), lo, hi)
    ph = {
        "gender": g,
        "age": rng.uniform(0.64, 0.88, n),  # young adult .. late middle age
        "muscle": normal(0.5, 0.15, 0.1, 0.95),
        # MakeHuman's whole weight slider only spans a body mass index of about 18 to 25.
        "weight": normal(0.6, 0.28, 0.0, 1.0),
        "proportions": normal(0.5, 0.2, 0.0, 1.0),
    }
    stature = rng.normal(1.76 - 0.13 * g, 0.068, n)

    def coefficients(height):
        p = dict(ph, height=height)
        p = np.stack([p[k] for k in model.phenotype_labels], 1)
        p = torch.as_tensor(p, dtype=model.dtype)
        zero = p.new_zeros((n, 0))
        return model._get_phenotype_blendshape_coefficients(p, zero, zero).numpy()

    # MakeHuman's height slider is relative: find the value that gives the stature.
    z = model.blendshapes[:, :, 2].numpy()
    z0 = model.template_vertices[:, 2].numpy()

    def measure(height):
        c = coefficients(height)
        out = np.empty(n)
        for i in range(0, n, 250):
            v = z0 + c[i:i + 250] @ z
            out[i:i + 250] = v.max(1) - v.min(1)
        return out

    h0, h1 = np.full(n, 0.2), np.full(n, 0.6)
    s0, s1 = measure(h0), measure(h1)
    for _ in range(3):
        h2 = np.clip(h1 + (stature - s1) * (h1 - h0) / (s1 - s0 + 1e-12), 0.0, 1.0)
        h0, s0, h1 = h1, s1, h2
        s1 = measure(h1)
        if np.abs(h1 - h0).max() < 1e-6:
            break
    return coefficients(h1), dict(ph, height=h1, stature=s1)


# --- folding the rig ---------------------------------------------------------------------

def fold(bone):
    """Shares of a bone of the source rig in our joints: [(joint, share)]."""
    base, _, side = bone.partition(".")
    s = {"L": "l_", "R": "r_"}.get(side, "")
    if base in ("root", "pelvis"):
        return [("pelvis", 1.0)]
    if base == "spine05":
        # Spans from the pelvis to the pivot of spine1: half of each blends smoothly.
        return [("pelvis", 0.5), ("spine1", 0.5)]
    if base == "neck03":
        return [("neck", 0.5), ("head", 0.5)]
    table = {
        "spine04": "spine1", "spine03": "spine2", "spine02": "spine3", "spine01": "spine3",
        "neck01": "neck", "neck02": "neck", "head": "head", "upperleg": "hip",
        "lowerleg": "knee", "foot": "ankle", "toe": "foot", "clavicle": "collar",
        "shoulder": "collar", "upperarm": "shoulder", "lowerarm": "elbow",
        "wrist": "wrist", "metacarpal": "wrist", "finger": "wrist", "eye": "eye",
    }
    for key in (base, base.rstrip("0123456789"), base.split("-")[0].rstrip("0123456789")):
        if key in table:
            return [(s + table[key], 1.0)]
    raise ValueError(f"bone {bone} has no joint")


def fold_weights(model):
    """Dense weights of the source rig (V, B) and folded ones (V, 24)."""
    idx = model.vertex_bone_indices.numpy()
    w = model.vertex_bone_weights.numpy()
    dense = np.zeros((len(idx), len(model.bone_labels)))
    np.add.at(dense, (np.arange(len(idx))[:, None], idx), w)
    dense /= dense.sum(1, keepdims=True)
    share = np.zeros((dense.shape[1], 24))
    for b, bone in enumerate(model.bone_labels):
        for joint, part in fold(bone):
            share[b, J[joint]] += part
    return dense, dense @ share


def mirror_map(points, tol=1e-3):
    """mirror[i] = vertex at the mirrored place of vertex i."""
    d, m = cKDTree(points).query(points * [-1, 1, 1])
    assert d.max() < tol, f"template not symmetric: {d.max()}"
    assert np.array_equal(m[m], np.arange(len(m))), "mirror map is not an involution"
    return m


def best_four(w):
    """Best four joints of each vertex as (index U8, weight F16), and the weight lost."""
    index = np.argsort(-w, 1, kind="stable")[:, :4]
    top = np.take_along_axis(w, index, 1)
    lost = 1 - top.sum(1)
    top = top / top.sum(1, keepdims=True)
    index = np.where(top > 0, index, index[:, :1])
    return index.astype(np.uint8), top.astype(np.float16), lost


def read_weights(index, weight):
    """The weights as a reader sees them: f16 widened, sum made 1; dense (V, 24)."""
    w = weight.astype(np.float64)
    w /= w.sum(1, keepdims=True)
    dense = np.zeros((len(w), 24))
    np.add.at(dense, (np.arange(len(w))[:, None], index), w)
    return dense


# --- the zero pose -----------------------------------------------------------------------

class Baker:
    """Takes rest meshes of the source model to the zero pose."""

    def __init__(self, model, dense, weights):
        self.labels = list(model.bone_labels)
        self.weights = weights  # (V, 24) of the asset
        turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)  # z up -> y up
        self.v0 = model.template_vertices.numpy() @ turn.T
        self.dv = model.blendshapes.numpy() @ turn.T
        self.h0 = model.template_bone_heads.numpy() @ turn.T
        self.dh = model.bone_heads_blendshapes.numpy() @ turn.T
        self.twisted = {}
        for s in "LR":
            hand = [b for b, n in enumerate(self.labels) if n.endswith("." + s)
                    and n.split("-")[0].split(".")[0].rstrip("0123456789")
                    in ("wrist", "metacarpal", "finger")]
            col = lambda name: dense[:, self.labels.index(name + "." + s)]
            # Share of the forearm's twist that each vertex takes: none at the elbow, all
            # at the hand, applied as three rigid parts blended by the source weights.
            self.twisted[s] = [(0.25, col("lowerarm01")), (0.75, col("lowerarm02")),
                               (1.0, dense[:, hand].sum(1))]

    def heads(self, coeff):
        return self.h0 + np.tensordot(coeff, self.dh, 1)

    def joints(self, heads):
        """Joint centres (N, 24, 3) from bone heads (N, B, 3)."""
        at = lambda name: heads[:, self.labels.index(name)]
        out = np.empty((len(heads), 24, 3))
        for i, name in enumerate(JOINTS):
            s = {"l_": "L", "r_": "R"}.get(name[:2])
            key = name[2:] if s else name
            if key == "foot":
                out[:, i] = np.mean([at(t.format(s=s)) for t in TOE_BASES], 0)
            else:
                out[:, i] = at(JOINT_BONE[key].format(s=s))
        return out

    def rotations(self, joints, heads):
        """A-pose -> zero pose rotation of each joint, and the forearm twists."""
        n = len(joints)
        at = lambda name: heads[:, self.labels.index(name)]
        q = np.tile(np.eye(3), (n, 24, 1, 1))
        twist = {}
        for s, p, sign in (("L", "l_", 1.0), ("R", "r_", -1.0)):
            j = lambda name: joints[:, J[p + name]]
            out = np.array([sign, 0.0, 0.0])
            forward = np.array([0.0, 0.0, 1.0])
            # The elbow bends forward in the zero pose, so its plane gives the roll of the
            # arm: upper arm along x, bending direction along z.
            upper, fore = unit(j("elbow") - j("shoulder")), unit(j("wrist") - j("elbow"))
            q[:, J[p + "shoulder"]] = align(upper, perpendicular(fore, upper), out, forward)
            q[:, J[p + "elbow"]] = align(fore, -perpendicular(upper, fore), out, forward)
            # Palm down: fingers along x, from little finger to index along z.
            knuckles = np.mean([at(f"finger{k}-1.{s}") for k in (2, 3, 4, 5)], 0)
            across = at(f"finger2-1.{s}") - at(f"finger5-1.{s}")
            hand = align(knuckles - j("wrist"), across, out, forward)
            t = twist_angle(np.swapaxes(q[:, J[p + "elbow"]], 1, 2) @ hand, fore)
            twist[s] = (t, fore)
            back = Rotation.from_rotvec(-t[:, None] * fore).as_matrix()
            q[:, J[p + "wrist"]] = hand @ back
            # Legs: thighs a little out, shins vertical, feet keep the flat sole of the
            # rest pose and only turn about the vertical.
            down = np.array([sign * np.sin(THIGH_OUT), -np.cos(THIGH_OUT), 0.0])
            q[:, J[p + "hip"]] = swing(j("knee") - j("hip"), down)
            q[:, J[p + "knee"]] = swing(j("ankle") - j("knee"), np.array([0.0, -1.0, 0.0]))
            toes = j("foot") - j("ankle")
            yaw = sign * FOOT_OUT - np.arctan2(toes[:, 0], toes[:, 2])
            foot = Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0]).as_matrix()
            q[:, J[p + "ankle"]] = foot
            q[:, J[p + "foot"]] = foot
        return q, twist

    def bake(self, coeff, points=None):
        """Zero-pose vertices (N, V, 3) and joints (N, 24, 3), pelvis at the origin.

        points: optional names of bones whose heads are carried along with their joint;
        then returned as a third array (N, P, 3).
        """
        heads = self.heads(coeff)
        rest = self.joints(heads)
        q, twist = self.rotations(rest, heads)
        zero = np.zeros_like(rest)
        for i, p in enumerate(PARENTS):
            if p >= 0:
                zero[:, i] = zero[:, p] + np.einsum(
                    "nij,nj->ni", q[:, p], rest[:, i] - rest[:, p])
        verts = np.empty((len(coeff), len(self.v0), 3))
        carried = None if points is None else np.empty((len(coeff), len(points), 3))
        for i in range(len(coeff)):
            v = self.v0 + np.tensordot(coeff[i], self.dv, 1)
            spin = {}
            for s, wrist in (("L", J["l_wrist"]), ("R", J["r_wrist"])):
                t, axis = twist[s][0][i], twist[s][1][i]
                c = rest[i, wrist]
                moved = v.copy()
                for share, w in self.twisted[s]:
                    used = w > 0
                    r = Rotation.from_rotvec(share * t * axis).as_matrix()
                    moved[used] += w[used, None] * ((v[used] - c) @ (r - np.eye(3)).T)
                    spin[s] = (r, c)  # the last one is the hand's
                v = moved
            # v_A = sum_k w_k (Q_k^T (v_T - x_k) + r_k), solved for v_T.
            back = np.swapaxes(q[i], 1, 2)
            m = np.tensordot(self.weights, back, 1)
            offset = self.weights @ (rest[i] - np.einsum("kij,kj->ki", back, zero[i]))
            verts[i] = np.linalg.solve(m, (v - offset)[..., None])[..., 0]
            if points is not None:
                for k, name in enumerate(points):
                    joint = J[fold(name)[-1][0]]
                    x = heads[i, self.labels.index(name)]
                    if JOINTS[joint].endswith("wrist"):
                        r, c = spin[name[-1]]
                        x = r @ (x - c) + c
                    carried[i, k] = q[i, joint] @ (x - rest[i, joint]) + zero[i, joint]
        return (verts, zero) if points is None else (verts, zero, carried)


# --- markers -----------------------------------------------------------------------------

def place_markers(v, faces, part, joints, heads, mirror):
    """One vertex per SSM2 marker, placed by anatomy on the zero pose.

    Each marker is a ray from a point inside the body (given by joints) outwards through
    the skin of the named parts; the marker is the nearest vertex where the ray leaves.
    Only the left and middle markers are described, the right ones are mirrored.
    """
    j = lambda name: joints[J[name]]
    h = lambda name: heads[name]
    mix = lambda a, b, t: a + t * (b - a)
    vec = lambda x, y, z: np.array([x, y, z], float)
    hip, knee, ankle, ball = j("l_hip"), j("l_knee"), j("l_ankle"), j("l_foot")
    sho, elb, wri = j("l_shoulder"), j("l_elbow"), j("l_wrist")
    eye = j("l_eye")
    sole = v[:, 1].min()
    ground = lambda p, y: vec(p[0], sole + y, p[2])
    skull = v[np.isin(part, [J["head"]])]
    skull_z = 0.5 * (skull[:, 2].min() + eye[2])
    centre = vec(0, eye[1] + 0.05, skull_z)
    pelvis, sp1, sp2, sp3, neck = (j(k) for k in "pelvis spine1 spine2 spine3 neck".split())
    clav_y = j("l_collar")[1] - 0.015
    chest = lambda x, y: vec(x, y, sp3[2])
    bust_y = clav_y - 0.155

    trunk = "pelvis l_hip r_hip spine1 spine2 spine3 l_collar r_collar neck".split()
    shoulder = trunk + ["l_shoulder"]
    head, arm, leg = ["head", "neck"], ["l_shoulder", "l_elbow", "l_wrist"], ["l_hip", "l_knee"]
    foot = ["l_ankle", "l_foot", "l_knee"]
    at = {  # name: (inner point, direction, parts)
        "C7": (neck + vec(0, -0.005, 0), (0, 0.1, -1), trunk),
        "CLAV": (chest(0, clav_y), (0, 0, 1), trunk),
        "STRN": (chest(0, bust_y - 0.01), (0, 0, 1), trunk),
        "T8": (chest(0, mix(sp3, neck, 0.30)[1]), (0, 0, -1), trunk),
        "MBLLY": (vec(0, sp1[1] + 0.02, sp1[2]), (0, 0, 1), trunk),
        "LFHD": (centre, (0.55, 0.05, 1.0), head),
        "LBHD": (centre, (0.55, 0.05, -1.0), head),
        "LCHEECK": (vec(eye[0] * 1.15, eye[1] - 0.045, skull_z), (0.15, 0, 1), head),
        "LSHO": (mix(sho, j("l_collar"), 0.10), (0, 1, 0), shoulder),
        "LBSH": (sho + vec(-0.035, -0.05, 0), (0, 0, -1), shoulder),
        "LBUST": (chest(0.095, bust_y), (0, 0, 1), trunk),
        "LBUSTLO": (chest(0.085, bust_y - 0.075), (0, 0, 1), trunk),
        "LBAK": (vec(0.085, sp3[1] + 0.03, sp3[2]), (0, 0, -1), trunk),
        "LNWST": (vec(0, sp2[1] + 0.01, sp2[2]), (1, 0, 0.25), trunk),
        "LFWT": (vec(hip[0] * 0.95, pelvis[1] + 0.045, pelvis[2]), (0.35, 0, 1), trunk),
        "LBWT": (vec(0.05, pelvis[1] + 0.065, pelvis[2]), (0, 0, -1), trunk),
        "LBUM": (vec(hip[0] * 0.9, hip[1] - 0.02, hip[2]), (0, 0, -1), trunk),
        "LTHI": (mix(hip, knee, 0.50), (1, 0, 0), leg),
        "LFTHI": (mix(hip, knee, 0.40), (0.25, 0, 1), leg),
        "LFTHIIN": (mix(hip, knee, 0.55), (-0.6, 0, 0.8), leg),
        "LKNE": (knee, (1, 0, -0.05), leg),
        "LKNI": (knee, (-1, 0, -0.05), leg),
        "LTIB": (mix(knee, ankle, 0.40), (0.3, 0, 1), leg),
        "LANK": (ankle, (1, 0, -0.1), foot),
        "LHEE": (ground(ankle, 0.035), (0, 0, -1), foot),
        "LMT1": (ground(h("toe1-1.L"), 0.03), (-1, 0, 0), foot),
        "LMT5": (ground(h("toe5-1.L") + vec(0, 0, -0.005), 0.02), (1, 0, 0), foot),
        "LRSTBEEF": (ground(mix(ankle, ball, 0.45), 0.022), (1, 0, 0), foot),
        "LTOE": (ground(h("toe2-2.L"), 0.02), (-0.05, 0.35, 1), foot),
        "LBCEP": (mix(sho, elb, 0.50), (0, 0.15, 1), arm),
        "LELB": (elb, (0, 1, -0.45), arm),
        "LELBIN": (elb, (0, -1, -0.25), arm),
        "LFRM2": (mix(elb, wri, 0.50), (0, 1, -0.35), arm),
        "LFRM2IN": (mix(elb, wri, 0.50), (0, -1, 0.35), arm),
        "LIWR": (wri + vec(-0.01, 0, 0), (0, 0.25, 1), arm),
        "LOWR": (wri + vec(-0.01, 0, 0), (0, 0.25, -1), arm),
        "LFIN": (h("finger3-1.L"), (0, 1, 0), arm),
        "LTHMB": (h("finger1-2.L"), (0, 1, 0.4), arm),
    }
    found = {}
    for name, (origin, direction, parts) in at.items():
        d = unit(np.asarray(direction, float))
        ok = np.isin(part, [J[p] for p in parts])
        tri = faces[ok[faces].all(1)]
        a, b, c = v[tri[:, 0]], v[tri[:, 1]], v[tri[:, 2]]
        pv = np.cross(d, c - a)
        det = np.sum((b - a) * pv, 1)
        inv = 1 / np.where(np.abs(det) < 1e-14, np.inf, det)
        u = np.sum((origin - a) * pv, 1) * inv
        qv = np.cross(origin - a, b - a)
        w = (qv @ d) * inv
        t = np.sum((c - a) * qv, 1) * inv
        hit = (u >= -1e-9) & (w >= -1e-9) & (u + w <= 1 + 1e-9) & (t > 0)
        assert hit.any(), f"marker {name}: no surface"
        far = np.argmax(np.where(hit, t, -1))
        ids = tri[far]
        if name[0] != "L":
            ids = np.flatnonzero(mirror == np.arange(len(v)))  # the middle line
            ids = ids[ok[ids]]
        point = origin + t[far] * d
        found[name] = ids[np.argmin(np.linalg.norm(v[ids] - point, axis=1))]
    for name in list(found):
        if name[0] == "L":
            found["R" + name[1:]] = mirror[found[name]]
    return np.array([found[n] for n in SSM2], np.int32)


# --- main --------------------------------------------------------------------------------

def main():
    ap = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    ap.add_argument("--out", default="checkpoints/body/body.safetensors")
    ap.add_argument("--report", help="write the measured figures here as JSON")
    ap.add_argument("--adults", type=int, default=1500)
    ap.add_argument("--held-out", type=int, default=200)
    ap.add_argument("--seed", type=int, default=7)
    args = ap.parse_args()

    torch.set_num_threads(2)
    from anny import Anny
    model = Anny(rig="anny", topology="anny", phenotypes="default", skinning_method="lbs")
    rng = np.random.default_rng(args.seed)
    fig = {}

    # Weights: folded, made symmetric, cut to four.
    dense, folded = fold_weights(model)
    template = model.template_vertices.numpy()
    mirror = mirror_map(template)
    folded = 0.5 * (folded + folded[mirror][:, SWAP])
    skin_index, skin_weight, lost = best_four(folded)
    weights = read_weights(skin_index, skin_weight)
    fig["weight_lost_max"], fig["weight_lost_mean"] = lost.max(), lost.mean()
    part = weights.argmax(1).astype(np.uint8)

    # Sample and bake.
    baker = Baker(model, dense, weights)
    coeff, ph = sample_adults(model, args.adults + args.held_out, rng)
    verts = np.empty((len(coeff), len(template) * 3), np.float32)
    joints = np.empty((len(coeff), 24, 3))
    uneven = 0.0
    for i in range(0, len(coeff), 50):
        v, x = baker.bake(coeff[i:i + 50])
        # Left and right are averaged: the source is symmetric to about 2 mm, the asset
        # exactly.
        twin = v[:, mirror] * [-1, 1, 1]
        uneven = max(uneven, np.abs(v - twin).max())
        v = 0.5 * (v + twin)
        joints[i:i + 50] = 0.5 * (x + x[:, SWAP] * [-1, 1, 1])
        verts[i:i + 50] = v.reshape(len(v), -1)
    fig["asymmetry_removed_mm"] = uneven / 2 * 1000
    n = args.adults
    mean = verts[:n].astype(np.float64).mean(0)
    centred = verts - mean.astype(np.float32)

    # Principal directions by the Gram matrix, scaled to one standard deviation.
    gram = (centred[:n] @ centred[:n].T).astype(np.float64)
    val, vec = np.linalg.eigh(gram)
    order = np.argsort(-val)[:16]
    fig["variance_kept"] = {k: float(val[order[:k]].sum() / val.sum()) for k in (1, 5, 10, 16)}
    fig["variance_share"] = (val[order[:10]] / val.sum()).tolist()
    order = order[:10]
    dirs = (vec[:, order].T.astype(np.float32) @ centred[:n]).astype(np.float64)
    dirs = dirs / np.linalg.norm(dirs, axis=1, keepdims=True)
    sd = np.sqrt(val[order] / (n - 1))
    dirs *= sd[:, None]
    # Signs: the strongest correlation of each component with a phenotype is positive
    # (so the first one is "taller"); the correlations go into the card.
    betas = centred.astype(np.float64) @ (dirs / (sd ** 2)[:, None]).T
    names = ["stature", "weight", "gender", "muscle", "age", "proportions"]
    fig["sampled"] = {m: [float(ph[m].mean()), float(ph[m].std())] for m in names}
    corr = np.array([[np.corrcoef(betas[:n, k], ph[m][:n])[0, 1] for m in names]
                     for k in range(10)])
    sign = np.sign(corr[np.arange(10), np.abs(corr).argmax(1)])
    dirs, betas, corr = dirs * sign[:, None], betas * sign, corr * sign[:, None]
    fig["correlation"] = {f"beta{k}": {m: round(float(c), 2) for m, c in zip(names, corr[k])}
                          for k in range(10)}

    v_template = mean.reshape(-1, 3).astype(np.float32)
    shapedirs = dirs.T.reshape(len(template), 3, 10).astype(np.float16)
    joints_template = joints[:n].mean(0)
    fit = np.linalg.lstsq(betas[:n], (joints[:n] - joints_template).reshape(n, -1), rcond=None)[0]
    joint_dirs = fit.T.reshape(24, 3, 10).astype(np.float32)
    joints_template = joints_template.astype(np.float32)

    # Errors on adults that were not used.
    held = centred[n:].astype(np.float64)
    again = betas[n:] @ shapedirs.astype(np.float64).reshape(-1, 10).T
    err = np.linalg.norm((held - again).reshape(len(held), -1, 3), axis=2) * 1000
    fig["vertex_error_mm"] = {"mean": err.mean(), "p99": np.percentile(err, 99), "max": err.max()}
    jerr = joints[n:] - joints_template - np.einsum("kcb,nb->nkc", joint_dirs, betas[n:])
    jerr = np.linalg.norm(jerr, axis=2) * 1000
    fig["joint_error_mm"] = {"mean": jerr.mean(), "p99": np.percentile(jerr, 99), "max": jerr.max()}

    # How far linear skinning of the asset is from the source in the A-pose it came from
    # is nil by construction; the smallest singular value tells how much the T-pose swells.
    heads = baker.heads(coeff[:1])
    q, twist = baker.rotations(baker.joints(heads), heads)
    sv = np.linalg.svd(np.tensordot(weights, np.swapaxes(q[0], 1, 2), 1), compute_uv=False)
    fig["smallest_singular_value"] = sv[:, -1].min()
    fig["forearm_twist_deg"] = {s: float(np.rad2deg(twist[s][0][0])) for s in "LR"}
    fig["arm_raise_deg"] = float(np.rad2deg(
        Rotation.from_matrix(q[0, J["l_shoulder"]]).magnitude()))

    # Faces, outward.
    faces = model.faces.numpy().astype(np.int64)
    uv_faces = model.face_texture_coordinate_indices.numpy().astype(np.int64)
    used, uv_faces = np.unique(uv_faces, return_inverse=True)  # drop helpers' coordinates
    uv_faces = uv_faces.reshape(-1, 3)
    uv = model.texture_coordinates.numpy()[used]
    tri = v_template[faces].astype(np.float64)
    volume = np.sum(tri[:, 0] * np.cross(tri[:, 1], tri[:, 2])) / 6
    if volume < 0:
        faces, uv_faces, volume = faces[:, ::-1], uv_faces[:, ::-1], -volume
    fig["volume_l"] = volume * 1000

    # Markers and feet.
    marker_bones = ["toe1-1.L", "toe5-1.L", "toe2-2.L", "finger3-1.L", "finger1-2.L"]
    mean_coeff = coeff[:n].mean(0, keepdims=True)
    _, x, carried = baker.bake(mean_coeff, marker_bones)
    heads = dict(zip(marker_bones, carried[0]))
    markers = place_markers(v_template.astype(np.float64), faces, part,
                            joints_template.astype(np.float64), heads, mirror)
    assert len(set(markers.tolist())) == 67
    foot_joints = [J[k] for k in ("l_ankle", "r_ankle", "l_foot", "r_foot")]
    foot_vertices = np.flatnonzero(np.isin(part, foot_joints)).astype(np.int32)

    tensors = {
        "v_template": v_template,
        "shapedirs": shapedirs,
        "faces": faces.astype(np.uint16),
        "skin_index": skin_index,
        "skin_weight": skin_weight,
        "joints_template": joints_template,
        "joint_dirs": joint_dirs,
        "parents": np.array(PARENTS, np.int32),
        "uv": uv.astype(np.float16),
        "uv_faces": uv_faces.astype(np.uint16),
        "part": part,
        "foot_vertices": foot_vertices,
        "markers": markers,
        # Vertex numbers in MakeHuman's base mesh, for clothes that bind to it.
        "base_vertex": model.base_mesh_vertex_indices.numpy().astype(np.uint16),
        "mirror": mirror.astype(np.uint16),
    }
    meta = {"format": "egogen-body-1", "joints": " ".join(JOINTS), "markers": " ".join(SSM2)}
    os.makedirs(os.path.dirname(args.out) or ".", exist_ok=True)
    fd, tmp = tempfile.mkstemp(dir=os.path.dirname(args.out) or ".")
    os.close(fd)
    save_file({k: np.ascontiguousarray(t) for k, t in tensors.items()}, tmp, metadata=meta)
    os.chmod(tmp, 0o644)
    os.replace(tmp, args.out)

    # Figures.
    def stature(b):
        v = v_template + shapedirs.astype(np.float32) @ np.asarray(b, np.float32)
        return float(v[:, 1].max() - v[:, 1].min())

    fig["V"], fig["F"], fig["U"] = len(v_template), len(faces), len(tensors["uv"])
    fig["foot_vertices"] = len(foot_vertices)
    fig["bytes"] = os.path.getsize(args.out)
    fig["stature_mean"] = stature(np.zeros(10))
    for k in range(3):
        fig[f"stature_beta{k}_-2_+2"] = [stature(-2 * np.eye(10)[k]), stature(2 * np.eye(10)[k])]
    sole = v_template[:, 1].min()
    fig["pelvis_above_sole"] = float(-sole)
    low = [v_template[np.isin(part, [J[p + "ankle"], J[p + "foot"]]), 1].min() for p in ("l_", "r_")]
    fig["sole_left_right"] = [float(x) for x in low]
    fig["joints"] = {n: [round(float(c), 4) for c in x] for n, x in zip(JOINTS, joints_template)}
    fig["markers"] = {n: [round(float(c), 3) for c in v_template[m] - [0, sole, 0]]
                      for n, m in zip(SSM2, markers)}
    text = json.dumps(fig, indent=1, default=float)
    print(text)
    if args.report:
        with open(args.report, "w") as f:
            f.write(text)


if __name__ == "__main__":
    main()
