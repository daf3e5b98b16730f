"""People that walk round a box, many at a time, in PyTorch: the environment `motion` as one would write it there, for motion.py.

The motion model, body, seeds and pose prior are this project's own, read from checkpoints/, so the motion is the same up to rounding.
Shapes: n people, t frames; rotations are (..., 3, 3). Frames of people are planar: a turn about z and a shift on the floor.
"""
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from torch.nn.functional import leaky_relu, linear, normalize, relu

ROOT = Path(__file__).resolve().parents[2] / "checkpoints"
MARKERS, RAYS, SEED, FUTURE, FRAMES = 67, 32, 2, 18, 20
FEET = [47, 60, 55, 16, 30, 25]
PELVIS, L_HIP, R_HIP, HEAD, EYES = 0, 1, 2, 15, [22, 23]
# SMPL-X: vertices, joints, and what its pose correctives depend on.
MESH, MESH_JOINTS, FEATURE = 10_475, 55, 54 * 9
MAX_STEPS, RANGE, CELL = 11, 7.0, 0.1


def tensors(path):
    with safe_open(ROOT / path, "np") as file:
        return {name: torch.as_tensor(file.get_tensor(name).astype(np.float32)) for name in file.keys()}


class Layers:
    """Dense layers and GRU cells by their names in a file."""

    def __init__(self, path):
        self.t = tensors(path)

    def __call__(self, name, x):
        return linear(x, self.t[f"{name}.weight"], self.t[f"{name}.bias"])

    def cell(self, name, suffix, x, h):
        weights = (self.t[f"{name}.{part}{suffix}"] for part in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"))
        return torch.gru_cell(x, h, *weights)


class Motion:
    """Markers of two frames and a latent to 18 frames of markers, and those to bodies."""

    def __init__(self):
        self.p, self.r = Layers("motion/predictor.safetensors"), Layers("motion/regressor.safetensors")

    def decode(self, seed, z):
        p, n = self.p, len(z)
        h_x = torch.zeros(n, 256)
        for frame in seed.unbind(1):
            h_x = p.cell("x_enc", "_l0", frame, h_x)
        h = h_x
        for i in range(3):
            h = torch.tanh(p(f"drnn_mlp.layers.{i}", h))
        frame, out = seed[:, -1], []
        for _ in range(FUTURE):
            h = p.cell("d_rnn", "", torch.cat([h_x, z, frame], 1), h)
            wide = torch.tanh(p("d_mlp.layers.0", h))
            frame = frame + p("d_out", torch.tanh(p("d_mlp.layers.1", wide)))
            out.append(frame)
        return torch.stack(out, 1)

    def regress(self, markers, betas):
        """Translation, 22 rotation matrices, hands; of m bodies."""
        r, body = self.r, torch.zeros(len(markers), 159)
        for _ in range(3):
            h = r("pnet.in_fc", torch.cat([markers, betas, body], 1))
            for i in range(10):
                inner = relu(r(f"pnet.layers.{i}.layers.0", h))
                h = relu(r(f"pnet.layers.{i}.layers.1", inner)) + h
            body = r("pnet.out_fc", h) + body
        six = body[:, 3:135].reshape(-1, 22, 3, 2)
        x = normalize(six[..., 0], dim=-1)
        y = normalize(six[..., 1] - x * (x * six[..., 1]).sum(-1, keepdim=True), dim=-1)
        return body[:, :3], torch.stack([x, y, torch.linalg.cross(x, y)], -1), body[:, 135:]


def to_axis_angle(rot):
    v = torch.stack([rot[..., 2, 1] - rot[..., 1, 2], rot[..., 0, 2] - rot[..., 2, 0], rot[..., 1, 0] - rot[..., 0, 1]], -1)
    s = v.norm(dim=-1, keepdim=True)
    trace = rot.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
    return v * (torch.atan2(s, trace - 1) / s.clamp_min(1e-9))


def to_matrix(v):
    t = v.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    (x, y, z), c, s = (v / t).unbind(-1), torch.cos(t)[..., 0], torch.sin(t)[..., 0]
    d = 1 - c
    rows = [c + d * x * x, d * x * y - s * z, d * x * z + s * y, d * x * y + s * z, c + d * y * y, d * y * z - s * x]
    rows += [d * x * z - s * y, d * y * z + s * x, c + d * z * z]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


class Body:
    """Linear-blend skinning of the markers, or of a mesh of SMPL-X's size with its pose correctives, of which the markers are part."""

    def __init__(self, mesh=False):
        t = tensors("body/body.safetensors")
        self.parents = t["parents"].long().tolist()
        points = t["markers"].long()
        if mesh:
            others = torch.ones(len(t["v_template"]), dtype=torch.bool)
            others[points] = False
            points = torch.cat([points, others.nonzero()[:, 0]])[:MESH]
        joints = MESH_JOINTS if mesh else 24
        self.template, self.dirs = t["v_template"][points], t["shapedirs"][points].reshape(-1, 10)
        self.joints, self.joint_dirs = t["joints_template"], t["joint_dirs"].reshape(-1, 10)
        self.weights = torch.zeros(len(points), joints).scatter_add_(1, t["skin_index"][points].long(), t["skin_weight"][points])
        # Nothing is known of SMPL-X's own here; zeros take as long.
        self.correctives = torch.zeros(FEATURE, len(points) * 3) if mesh else None

    def shape(self, betas):
        """Rest points and joints of each of n bodies."""
        rest = self.template + (betas @ self.dirs.T).unflatten(1, (-1, 3))
        return rest, self.joints + (betas @ self.joint_dirs.T).unflatten(1, (-1, 3))

    def pose(self, local, transl, joints):
        """Global rotations and positions of the joints, (m, 24, ...); `joints` (m, 24, 3) at rest."""
        rot, pos = [local[:, 0]], [joints[:, 0] + transl]
        for k in range(1, 24):
            up = self.parents[k]
            rot.append(rot[up] @ local[:, k] if k < 22 else rot[up])
            pos.append(pos[up] + (rot[up] @ (joints[:, k] - joints[:, up])[..., None])[..., 0])
        return torch.stack(rot, 1), torch.stack(pos, 1)

    def markers(self, rot, pos, local, rest, joints):
        """(m, 67, 3); `rest` and `joints` of each frame."""
        if self.correctives is not None:
            feature = torch.zeros(len(rot), 54, 9)
            feature[:, :21] = (local[:, 1:] - torch.eye(3)).flatten(2)
            rest = rest + (feature.flatten(1) @ self.correctives).unflatten(1, (-1, 3))
        bones = torch.zeros(len(rot), self.weights.shape[1], 12)
        bones[:, :24, :9] = rot.flatten(2)
        bones[:, :24, 9:] = pos - (rot @ joints[..., None])[..., 0]
        blend = self.weights @ bones
        return ((blend[..., :9].unflatten(-1, (3, 3)) @ rest[..., None])[..., 0] + blend[..., 9:])[:, :MARKERS]


def canonical(joints):
    """Turn and shift of the frame on the floor below the pelvis, x from left to right hip; `joints` (..., 24, 3)."""
    x = normalize((joints[..., R_HIP, :2] - joints[..., L_HIP, :2]), dim=-1)
    return turn(torch.atan2(x[..., 1], x[..., 0])), joints[..., PELVIS, :] * torch.tensor([1.0, 1.0, 0.0])


def turned(points, yaw):
    """Points (n, 2) of NumPy, each turned by its own angle."""
    (x, y), c, s = points.T, np.cos(yaw), np.sin(yaw)
    return np.c_[c * x - s * y, s * x + c * y]


def turn(yaw):
    """Turns about z, (..., 3, 3)."""
    c, s, o = torch.cos(yaw), torch.sin(yaw), torch.zeros_like(yaw)
    return torch.stack([c, -s, o, s, c, o, o, o, o + 1], -1).unflatten(-1, (3, 3))


def apply(rot, points):
    return points @ rot.mT


class People:
    """n people, each in a scene of its own: a square floor with a box in the middle.

    `copies`: how often each is computed; `bare`: a step asks the networks and does nothing else; `rays`: another way of casting them.
    """

    def __init__(self, n, weights, copies=1, mesh=False, bare=False, rays=None, seed=0):
        self.n, self.weights, self.copies, self.bare = n, weights, copies, bare
        self.motion, self.body, self.prior = Motion(), Body(mesh), Layers("pose/pose.safetensors")
        self.cast = rays or cast
        self.rng = np.random.default_rng(seed)
        self.bank = self.seeds(64)
        self.state = {name: value[torch.zeros(n, dtype=torch.long)] for name, value in self.bank.items()}
        for name, shape in {"turn": (3, 3), "shift": (3,), "goal": (3,), "dist": (), "box": (4,), "steps": ()}.items():
            self.state[name] = torch.zeros(n, *shape)

    def seeds(self, count):
        """The first seed motions, in their canonical frames."""
        t = tensors("motion/seeds.safetensors")
        params, betas = t["params"][:count], t["betas"][:count]
        rest, joints = (x.repeat_interleave(SEED, 0) for x in self.body.shape(betas))
        local = to_matrix(params[..., 3:69].unflatten(-1, (22, 3)))
        rot, pos = self.body.pose(local.flatten(0, 1), params[..., :3].flatten(0, 1), joints)
        markers = self.body.markers(rot, pos, local.flatten(0, 1), rest, joints)
        pairs = (x.unflatten(0, (count, SEED)) for x in (rot, pos, markers))
        return {"betas": betas} | reseed(params, *pairs, joints[::SEED, 0])[0]

    def reset(self, ids):
        """Puts those people before a new box, until none stands in it; their observations."""
        left = ids
        while len(left):
            self.place(torch.as_tensor(left))
            left = left[self.blocked()[left].numpy() > 0]
        return self.observe()[ids]

    def place(self, ids):
        s, draw, n = self.state, self.rng.uniform, len(ids)
        side, yaw, start = draw(0.5, 1.0, (n, 2)), draw(0, 2 * np.pi, n), np.zeros((n, 2))
        open_ = np.arange(n)
        while len(open_):
            start[open_] = draw(-2.0, 2.0, (len(open_), 2))
            off = np.abs(turned(start, -yaw)) - side / 2
            near = np.hypot(*np.maximum(off, 0).T) < 0.4
            open_ = np.flatnonzero(near | (np.hypot(*start.T) > 2.0))
        pick = torch.as_tensor(self.rng.integers(len(self.bank["betas"]), size=n))
        for name, value in self.bank.items():
            s[name][ids] = value[pick]
        face = np.arctan2(start[:, 0], -start[:, 1]) + draw(-0.63, 0.63, n)
        flat = lambda x: torch.as_tensor(np.c_[x, np.zeros(n)], dtype=torch.float32)
        s["turn"][ids], s["shift"][ids], s["goal"][ids] = turn(torch.as_tensor(face, dtype=torch.float32)), flat(start), flat(-start)
        s["goal"][ids, 2] = s["joints"][ids, 0, PELVIS, 2]
        s["box"][ids] = torch.as_tensor(np.c_[side / 2, np.cos(yaw), np.sin(yaw)], dtype=torch.float32)
        s["steps"][ids], s["dist"][ids] = 0, self.distances(0)[ids]

    def goals(self):
        """In everyone's own frame, (n, 3)."""
        s = self.state
        return apply(s["turn"].mT, (s["goal"] - s["shift"])[:, None])[:, 0]

    def distances(self, frame):
        return (self.state["joints"][:, frame, PELVIS] - self.goals()).norm(dim=-1)

    def step(self, z):
        """Observations, rewards, ends of everyone after latents `z` (n, 128)."""
        s, c, n = self.state, self.copies, self.n
        many = lambda x: x.repeat(c, *[1] * (x.dim() - 1))
        betas = many(s["betas"])
        predicted = self.motion.decode(many(s["markers"]).flatten(2), many(z))
        transl, six, hands = self.motion.regress(predicted.flatten(0, 1), betas.repeat_interleave(FUTURE, 0))
        s["steps"] += 1
        if self.bare:
            return self.observe(), torch.zeros(n), s["steps"] >= MAX_STEPS
        new = torch.cat([transl, to_axis_angle(six).flatten(1), hands], 1).unflatten(0, (-1, FUTURE))
        params = torch.cat([many(s["params"]), new], 1)
        params[:, 2:4, 6:] = 0.5 * (params[:, 1:3, 6:] + params[:, 3:5, 6:])
        rest, joints = self.body.shape(betas)
        local = to_matrix(params[..., 3:69].unflatten(-1, (22, 3)))
        each = lambda x, frames: x.repeat_interleave(frames, 0)
        rot, pos = self.body.pose(local.flatten(0, 1), params[..., :3].flatten(0, 1), each(joints, FRAMES))
        rot, pos = (x.unflatten(0, (-1, FRAMES)) for x in (rot, pos))
        new = [x[:, SEED:].flatten(0, 1) for x in (rot, pos, local)]
        skinned = self.body.markers(*new, each(rest, FUTURE), each(joints, FUTURE)).unflatten(0, (-1, FUTURE))
        blended = 0.5 * (skinned + predicted.unflatten(-1, (MARKERS, 3)))
        markers = torch.cat([s["markers"], blended[:n]], 1)
        last = (x[:n, FUTURE:] for x in (params, rot, pos, markers))
        seed, turned_, shifted = reseed(*last, joints[:n, 0])
        s["shift"] = s["shift"] + apply(s["turn"], shifted[:, None])[:, 0]
        s["turn"] = s["turn"] @ turned_
        s |= seed
        reward, ended = self.judge(markers, params[:n])
        return self.observe(), reward, ended

    def judge(self, markers, params):
        s, w, goal = self.state, self.weights, self.goals()
        feet = markers[:, :, FEET]
        speed = 20 * (feet[:, 2:] - feet[:, :-2]).norm(dim=-1).amin(-1)
        before, s["dist"] = s["dist"], self.distances(1)
        pelvis, head, view = s["joints"][:, 1, PELVIS], s["joints"][:, 1, HEAD], s["views"][:, 1]
        to, ahead = normalize((goal - pelvis)[:, :2], dim=-1), canonical(s["joints"][:, 1])[0][:, :2, 1]
        penetrates, arrived = self.blocked() >= 3, s["dist"] < 0.1
        terms = {
            "floor": torch.exp(-(feet[..., 2].amin(-1) - 0.02).clamp_min(0).mean(-1)),
            "skate": torch.exp(-(speed - 0.075).clamp_min(0).mean(-1)),
            "dist": before - s["dist"],
            "orient": ((ahead * to).sum(-1) + 1) / 2,
            "attention": ((view * normalize(goal - head, dim=-1)).sum(-1) + 1) / 2,
            "penetration": torch.where(penetrates, 0.0, 0.05),
            "success": arrived.float(),
            "arrival": torch.where(arrived & ~penetrates, MAX_STEPS - s["steps"], 0.0),
        }
        if w["pose"]:
            terms["pose"] = 0.05 * (self.embed(params[..., 6:69]).norm(dim=-1).mean(-1) < 4.894224)
        return sum(w[name] * value for name, value in terms.items()), arrived | penetrates | (s["steps"] >= MAX_STEPS)

    def embed(self, poses):
        t, x = self.prior.t, poses
        for i in (1, 2):
            name = f"bodyprior_enc_bn{i}"
            scale = t[f"{name}.weight"] / (t[f"{name}.running_var"] + 1e-5).sqrt()
            x = leaky_relu(self.prior(f"bodyprior_enc_fc{i}", (x - t[f"{name}.running_mean"]) * scale + t[f"{name}.bias"]), 0.2)
        return self.prior("bodyprior_enc_mu", x)

    def blocked(self):
        """Cells under each person's markers that are not floor."""
        s = self.state
        flat = s["markers"][..., :2].flatten(1, 2)
        lo, hi = flat.amin(1), flat.amax(1)
        at = (torch.arange(-20, 20) + 0.5) * CELL
        cells = torch.stack(torch.meshgrid(at, at, indexing="ij"), -1).flatten(0, 1)
        within = ((cells >= lo[:, None]) & (cells <= hi[:, None])).all(-1)
        world = cells @ s["turn"][:, :2, :2].mT + s["shift"][:, None, :2]
        return (within & ~self.free(world)).sum(1)

    def free(self, points):
        """Whether points (n, k, 2) of the world are floor."""
        half, cos, sin = self.state["box"][:, None, :2], *self.state["box"][:, None, 2:].unbind(-1)
        x, y = points.unbind(-1)
        inside = torch.stack([cos * x + sin * y, cos * y - sin * x], -1).abs() < half
        return ~inside.all(-1) & (points.abs() < 4.75).all(-1)

    def edges(self):
        """Ends of the eight edges of floor and box, (n, 8, 2) each."""
        half, cos, sin = self.state["box"][:, None, :2], *self.state["box"][:, None, 2:].unbind(-1)
        unit = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        x, y = (half * unit).unbind(-1)
        box, floor = torch.stack([cos * x - sin * y, sin * x + cos * y], -1), (4.75 * unit).expand(self.n, 4, 2)
        return torch.cat([floor, box], 1), torch.cat([floor.roll(-1, 1), box.roll(-1, 1)], 1)

    def observe(self):
        s, goal = self.state, self.goals()
        flat, to = s["markers"].flatten(2), normalize(goal[:, None, None] - s["markers"], dim=-1).flatten(2)
        scalars = torch.stack([1 / (1 + s["dist"]), 1 - s["steps"] / MAX_STEPS], 1)
        sight = torch.zeros(self.n, SEED * RAYS) if self.bare else self.look()
        return torch.cat([torch.cat([flat, to], 2).flatten(1), sight, scalars], 1)

    def look(self):
        s = self.state
        world = lambda points, shift: (apply(s["turn"], points) + shift)[..., :2]
        eyes = world(s["joints"][:, :, EYES].mean(2), s["shift"][:, None])
        ahead = world(s["views"], 0.0)
        angles = torch.linspace(-torch.pi / 2, torch.pi / 2, RAYS) + torch.atan2(ahead[..., 1], ahead[..., 0])[..., None]
        hits = self.cast(self, eyes, torch.stack([angles.cos(), angles.sin()], -1))
        return torch.where(self.free(eyes)[..., None], 2 * hits.clamp_max(RANGE) / RANGE - 1, -1.0).flatten(1)


def cast(people, eyes, rays):
    """Distances from eyes (n, 2, 2) along unit rays (n, 2, 32, 2) to the nearest edge."""
    a, b = people.edges()
    cross = lambda p, q: p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    edge, to = (b - a)[:, None, None], (a[:, None] - eyes[:, :, None])[:, :, None]
    det = cross(rays[..., None, :], edge)
    t, u = cross(to, edge) / det, cross(to, rays[..., None, :]) / det
    return torch.where((t >= 0) & (u >= 0) & (u <= 1), t, RANGE).amin(-1)


def reseed(params, rot, pos, markers, pelvis):
    """Two frames in the canonical frame of the first, and that frame. `pelvis` (n, 3): at rest."""
    frame, shift = canonical(pos[:, 0])
    back, pelvis, params = frame.mT, pelvis[:, None], params.clone()
    params[..., :3] = apply(back, params[..., :3] + pelvis - shift[:, None]) - pelvis
    params[..., 3:6] = to_axis_angle(back[:, None] @ rot[:, :, PELVIS])
    inside = lambda points: apply(back[:, None], points - shift[:, None, None])
    return {"params": params, "markers": inside(markers), "joints": inside(pos), "views": apply(back, rot[:, :, HEAD, :, 2])}, frame, shift
