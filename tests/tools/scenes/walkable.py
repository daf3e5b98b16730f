"""Writes tests/fixtures/scenes/walkable.json: what shapely says of the free floor between boxes.

Run from the repository root: python tests/tools/scenes/walkable.py
"""
import json
import math
from pathlib import Path

import numpy as np
from shapely import Point, Polygon, affinity, box

rng = np.random.default_rng(3)
# What stands higher than 5 cm and below 2 m is in the way.
HEIGHTS = [(0.0, 0.75), (0.4, 0.45), (1.9, 2.4), (0.0, 0.03), (2.1, 2.5)]


def num(x):
    return float(f"{x:.9g}")


def holes(area):
    return sum(Polygon(h).area > 0.05 for h in area.interiors)


def layout():
    size = rng.uniform(3, 6, 2).round(3)
    floor = box(*(-size / 2), *(size / 2))
    boxes, area, solid = [], floor, []
    for _ in range(int(rng.integers(1, 8))):
        low, high = HEIGHTS[int(rng.integers(0, len(HEIGHTS)))]
        b = {
            "centre": rng.uniform(-size / 2, size / 2).round(3).tolist(),
            "size": rng.uniform(0.3, 1.5, 2).round(3).tolist(),
            "yaw": round(float(rng.uniform(0, math.pi)), 4),
            "z": [low, high],
        }
        boxes.append(b)
        foot = box(-b["size"][0] / 2, -b["size"][1] / 2, b["size"][0] / 2, b["size"][1] / 2)
        foot = affinity.translate(affinity.rotate(foot, b["yaw"], (0, 0), use_radians=True), *b["centre"])
        if high > 0.05 and low < 2.0:
            solid.append(foot)
        elif high < 0.05:
            # A step this low is floor, beyond the floor's border too.
            area = area.union(foot)
    for foot in solid:
        area = area.difference(foot)
    parts = sorted(getattr(area, "geoms", [area]), key=lambda p: -p.area)
    largest = parts[0]
    # Slits that the program closes, or parts about as large as the largest, could go either way.
    if any(p.area > 0.8 * largest.area for p in parts[1:]) or abs(largest.buffer(-0.1).buffer(0.1).area - largest.area) > 0.02:
        return None
    narrow = largest.buffer(-0.08, join_style="mitre")
    if narrow.geom_type != "Polygon" or holes(narrow) != holes(largest):
        return None
    return size.tolist(), boxes, largest


cases = []
while len(cases) < 30:
    made = layout()
    if made is None:
        continue
    size, boxes, area = made
    points = []
    for p in rng.uniform(-3, 3, (40, 2)).round(4):
        distance = area.boundary.distance(Point(p))
        # Cells are 2.5 cm and lie before what blocks them.
        if distance > 0.06:
            points.append({"p": p.tolist(), "inside": bool(area.contains(Point(p)))})
    cases.append(
        {
            "floor": size,
            "boxes": boxes,
            "area": num(area.area),
            "length": num(area.boundary.length),
            "holes": holes(area),
            "points": points,
        }
    )
Path("tests/fixtures/scenes").mkdir(parents=True, exist_ok=True)
with open("tests/fixtures/scenes/walkable.json", "w") as f:
    f.write("[\n" + ",\n".join(json.dumps(c, separators=(",", ":")) for c in cases) + "\n]\n")
