"""Compares two folders of fixtures: the same files, the same numbers within 1e-4 of each array's largest entry.

Usage: compare.py COMMITTED REMADE. Uses the standard library alone.
"""

import json
import struct
import sys
import zipfile
from pathlib import Path

TOLERANCE = 1e-4
CODES = {"F32": "f", "F64": "d", "I32": "i", "I64": "q", "U8": "B", "BOOL": "?"}


def arrays(path):
    """Named flat lists of numbers of a safetensors or JSON file; the bytes of an archive's entries or of any other file."""
    data = path.read_bytes()
    if path.suffix == ".safetensors":
        size = struct.unpack("<Q", data[:8])[0]
        header = json.loads(data[8 : 8 + size])
        header.pop("__metadata__", None)
        for name, t in sorted(header.items()):
            start, end = (8 + size + o for o in t["data_offsets"])
            code = CODES[t["dtype"]]
            yield name, struct.unpack(f"<{(end - start) // struct.calcsize(code)}{code}", data[start:end])
    elif path.suffix == ".json":
        flat = []
        flatten(json.loads(data), flat)
        yield "numbers", flat
    elif path.suffix == ".npz":
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                yield name, archive.read(name)
    else:
        yield "text", data


def flatten(value, out):
    if isinstance(value, dict):
        for key in sorted(value):
            flatten(value[key], out)
    elif isinstance(value, list):
        for item in value:
            flatten(item, out)
    elif value is not None:
        out.append(value)


def differs(a, b):
    if len(a) != len(b):
        return f"{len(a)} entries against {len(b)}"
    if isinstance(a, bytes):
        return None if a == b else "other bytes"
    scale = max((abs(x) for x in a), default=0) or 1
    worst = max((abs(x - y) for x, y in zip(a, b)), default=0)
    return f"differ by {worst} at a scale of {scale}" if worst > TOLERANCE * scale else None


def main(committed, remade):
    bad = 0
    for path in sorted(p for p in committed.rglob("*") if p.is_file()):
        other = remade / path.relative_to(committed)
        mine, theirs = dict(arrays(path)), dict(arrays(other))
        problems = [f"{n}: {differs(mine[n], theirs[n])}" for n in mine if n in theirs and differs(mine[n], theirs[n])]
        problems += [f"{n}: only in one of them" for n in mine.keys() ^ theirs.keys()]
        print(f"{'DIFFERS' if problems else 'same':8}{path.relative_to(committed)} ({len(mine)} arrays)")
        for problem in problems:
            print(f"        {problem}")
        bad += bool(problems)
    print(f"{bad} fixtures differ")
    return bad != 0


sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
