"""This project's trainer beside Stable-Baselines3 and Tianshou: one recipe, one thread, some seeds, one after the other.

    cargo build --release
    python -m venv venv && venv/bin/pip install -r requirements.txt
    venv/bin/python compare.py ../../train/recipes/cartpole.toml
    venv/bin/python compare.py pendulum.toml --seeds 5

For each seed the three train in turn, so that whatever else the machine does meets all of them. Speeds are environment steps per second
of processor time, which other programs disturb less than the clock does; they are compared within a seed, and the table holds the
median of those ratios with the smallest and the largest. For this project it is the time of the whole program, start and tests
included, for the others that of training alone, which favours them. Returns are means over 64 episodes without noise after training.
"""
import argparse
import csv
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
THREADS = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "RAYON_NUM_THREADS": "1"}


def output(command):
    done = subprocess.run(command, env=os.environ | THREADS, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}\n{done.stderr}")
    return done.stdout


def ours(train, recipe, seed):
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        spent = lambda: sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
        before = spent()
        output([train, recipe, "--seed", str(seed), "--threads", "1", "--set", "test.every=1000", "--out", str(run)])
        seconds = spent() - before
        last = list(csv.DictReader((run / "metrics.csv").open()))[-1]
    steps = float(last["env_steps"])
    return {"return": float(last["test_det/return"]), "steps": int(steps), "steps_per_second": steps / seconds}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("recipe")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--train", default=str(HERE / "../../target/release/train"))
    args = parser.parse_args()
    results = {"here": [], "sb3": [], "tianshou": []}
    for seed in range(args.seeds):
        for name, runs in results.items():
            peer = [sys.executable, str(HERE / "peer.py"), name, args.recipe, str(seed)]
            runs.append(ours(args.train, args.recipe, seed) if name == "here" else json.loads(output(peer)))
            print(f"seed {seed} {name}: {runs[-1]}", file=sys.stderr)
    print("| trainer | return of each seed | mean | steps/s of processor time, median | times faster here: median (least to most) |")
    print("|---|---|---|---|---|")
    for name, runs in results.items():
        returns = [run["return"] for run in runs]
        ratios = [a["steps_per_second"] / b["steps_per_second"] for a, b in zip(results["here"], runs)]
        ratio = f"{statistics.median(ratios):.1f} ({min(ratios):.1f} to {max(ratios):.1f})"
        speed = statistics.median(run["steps_per_second"] for run in runs)
        shown = ", ".join(f"{x:.0f}" for x in returns)
        print(f"| {name} | {shown} | {statistics.mean(returns):.1f} | {speed:.0f} | {'' if name == 'here' else ratio} |")


main()
