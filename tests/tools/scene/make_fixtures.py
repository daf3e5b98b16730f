"""Writes tests/fixtures/scene/polygons.json: what shapely says about random polygons with holes.

Run from the repository root: python tests/tools/scene/make_fixtures.py
"""
import json
import math

import numpy as np
from shapely import Point, Polygon, LineString, affinity

rng = np.random.default_rng(1)


def star(centre, lo, hi, n):
    angles = np.sort(rng.uniform(0, 2 * math.pi, n))
    radii = rng.uniform(lo, hi, n)
    return [[round(float(centre[0] + r * math.cos(a)), 4), round(float(centre[1] + r * math.sin(a)), 4)] for a, r in zip(angles, radii)]


def num(x):
    return float(f"{x:.12g}")


def region():
    while True:
        exterior = star((0, 0), 2.5, 6, int(rng.integers(5, 14)))
        # Some holes overlap each other or leave the floor: the region is the difference.
        holes = [star(rng.uniform(-5, 5, 2), 0.2, 1.0, int(rng.integers(4, 8))) for _ in range(int(rng.integers(0, 5)))]
        area = Polygon(exterior)
        parts = [Polygon(h) for h in holes]
        if not area.is_valid or not all(p.is_valid and p.area > 0.01 for p in parts):
            continue
        for p in parts:
            area = area.difference(p)
        return {"exterior": exterior, "holes": holes}, area


def points(area):
    out = []
    for p in rng.uniform(-6, 6, (12, 2)).round(4):
        inside = bool(area.contains(Point(p)))
        # Outside, borders of the difference are not those of the rings, so the distance is asked of walkable points only.
        out.append({"p": p.tolist(), "inside": inside, "distance": num(area.boundary.distance(Point(p))) if inside else None})
    return out


def rays(area):
    out = []
    while len(out) < 24:
        o = rng.uniform(-6, 6, 2).round(4)
        if not area.contains(Point(o)):
            continue
        angle = round(float(rng.uniform(0, 2 * math.pi)), 6)
        ray = LineString([o, o + 50 * np.array([math.cos(angle), math.sin(angle)])])
        out.append({"origin": o.tolist(), "angle": angle, "distance": num(Point(o).distance(ray.intersection(area.boundary)))})
    return out


def cells(area):
    out = []
    while len(out) < 6:
        yaw, x, y = (round(float(v), 4) for v in rng.uniform((0, -6, -6), (2 * math.pi, 6, 6)))
        lo = rng.uniform(-0.6, -0.2, 2).round(4)
        hi = rng.uniform(0.2, 0.6, 2).round(4)
        centres = [(0.1 * i + 0.05, 0.1 * j + 0.05) for i in range(-9, 9) for j in range(-9, 9)]
        held = [c for c in centres if lo[0] <= c[0] <= hi[0] and lo[1] <= c[1] <= hi[1]]
        world = [affinity.translate(affinity.rotate(Point(c), yaw, (0, 0), use_radians=True), x, y) for c in held]
        # Centres within a rounding error of a border could go either way in single precision.
        if any(area.boundary.distance(w) < 1e-5 for w in world):
            continue
        if any(min(abs(c[k] - lo[k]), abs(c[k] - hi[k])) < 1e-5 for c in centres for k in (0, 1)):
            continue
        blocked = sum(not area.contains(w) for w in world)
        if blocked in (0, len(held)) and rng.uniform() < 0.8:
            continue
        out.append({"frame": [yaw, x, y], "box": [lo.tolist(), hi.tolist()], "blocked": blocked})
    return out


cases = []
for _ in range(40):
    polygon, area = region()
    cases.append({"polygon": polygon, "points": points(area), "rays": rays(area), "cells": cells(area)})
with open("tests/fixtures/scene/polygons.json", "w") as f:
    f.write("[\n" + ",\n".join(json.dumps(c, separators=(",", ":")) for c in cases) + "\n]\n")
