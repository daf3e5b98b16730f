"""Reads the shipped policy with the book's PyTorch loader: its golden pair must come out, and must not where a weight is changed.

Usage: check.py LOADER BUNDLE
"""

import importlib.util
import shutil
import sys
import tempfile
from pathlib import Path

from safetensors.torch import load_file, save_file

TOLERANCE = 1e-4


def main(loader, bundle):
    spec = importlib.util.spec_from_file_location("load_policy", loader)
    book = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(book)
    off = book.error(bundle)
    print(f"golden pair of {bundle}: off by {off:.2g}")
    assert off <= TOLERANCE, "the loader and the kernels differ"
    with tempfile.TemporaryDirectory() as copy:
        shutil.copytree(bundle, copy, dirs_exist_ok=True)
        path = Path(copy) / "policy.safetensors"
        weights = load_file(path)
        weights["critic.out.bias"] += 0.01
        save_file(weights, path)
        assert book.error(copy) > TOLERANCE, "the check cannot fail"


main(*sys.argv[1:])
