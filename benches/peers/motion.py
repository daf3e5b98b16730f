"""The recipes `paper` and `quick` beside Tianshou with everything in PyTorch: environment steps per second, collection and update.

    cargo build --release
    python -m venv venv && venv/bin/pip install -r motion-requirements.txt
    venv/bin/python motion.py paper             # this project, Tianshou in batches, in turn
    venv/bin/python motion.py paper --authors   # and as the authors arrange it
    venv/bin/python motion.py paper --ceiling   # this project alone, beside the processor's fastest product

The same network, minibatches, motion model, body and rewards in all of them, two threads (`--threads 1` on a busy machine, where threads
that wait for each other cost processor time). What takes turns:

    here      `train`: collect and update, by its own timing.csv; its processor time is that of a long run less that of a short one
    batched   Tianshou 0.5.1, 256 people at once in PyTorch (motion_people.py)
    bare      the same, but the environment only asks decoder and regressor: less than the task needs
    authors   Tianshou, one environment after the other, each computed four times over, a mesh of 10,475 vertices skinned with pose
              correctives in every frame, rays through shapely

The best of some products of two 2048 x 2048 matrices, in PyTorch, is taken before and after each run of `here`: the operations of its best
update's steps make some share of the mean of both rates.

An update is `run.collect_steps` steps of `run.envs` environments and the recipe's passes over them (authors: 256 steps, for patience).
The first one is not counted. All act through all 128 latents (the recipe `quick` through 12 of them), fit bodies to all frames (`quick` to 7 of 18) and take observations as they come (`quick` normalises them). Ratios are taken within a round, so that whatever else the machine does meets all of them.
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
import time
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE / "../.."
AUTHORS_STEPS = 256


def weights(recipe):
    paper = dict(floor=0.1, skate=0.3, dist=1.0, orient=0.1, attention=0.3, pose=0.1, penetration=0.1, success=0.5, arrival=0.0)
    return paper | recipe.get("env_options", {}).get("task", {}).get("weights", {})


def network(policy):
    """Actor and critic over one encoder, as docs/src/concepts/ppo.md describes them."""
    import torch
    from torch import nn
    from torch.nn.functional import leaky_relu

    class Encoder(nn.Module):
        def __init__(self):
            super().__init__()
            gru, self.octaves = policy["gru"], policy["octaves"]
            self.state, self.sight = (nn.GRU(width, gru[name], batch_first=True) for name, width in (("state", 402), ("egosensing", 32)))
            encoded = gru["state"] + gru["egosensing"] + 4 * self.octaves
            self.width = policy.get("trunk", encoded)
            self.project = nn.Linear(encoded, self.width) if "trunk" in policy else nn.Identity()

        def forward(self, obs):
            obs = torch.as_tensor(obs, dtype=torch.float32)
            state, sight = obs[:, :804].unflatten(1, (2, 402)), obs[:, 804:868].unflatten(1, (2, 32))
            angles = (obs[:, 868:, None] * 2.0 ** torch.arange(self.octaves)).flatten(1)
            return self.project(torch.cat([self.state(state)[1][0], self.sight(sight)[1][0], angles.sin(), angles.cos()], 1))

    class Head(nn.Module):
        def __init__(self, encoder, outputs, gain):
            super().__init__()
            self.encoder = encoder
            self.blocks = nn.ModuleList(nn.Linear(encoder.width, encoder.width) for _ in range(2 * policy["blocks"]))
            self.out = nn.Linear(encoder.width, outputs)
            for layer in [*self.blocks, self.out]:
                nn.init.orthogonal_(layer.weight, 2**0.5)
                nn.init.zeros_(layer.bias)
            self.out.weight.data *= gain

        def run(self, obs):
            h = self.encoder(obs)
            for a, b in zip(self.blocks[::2], self.blocks[1::2]):
                h = leaky_relu(b(leaky_relu(a(h)))) + h
            return self.out(h)

    class Actor(Head):
        def forward(self, obs, state=None, info=None):
            mu, logvar = self.run(obs).chunk(2, 1)
            return (mu, (0.5 * logvar.clamp(*policy["logvar"])).exp()), state

    class Critic(Head):
        def forward(self, obs):
            return self.run(obs)

    encoder = Encoder()
    return Actor(encoder, 256, 0.01), Critic(encoder, 1, 1.0)


def batched(recipe, bare):
    """All environments as one that Tianshou's collector takes for a vector."""
    import gymnasium
    import numpy as np
    import torch
    from motion_people import People
    from tianshou.data import Batch

    class Vector:
        is_async = False

        def __init__(self, n):
            self.people = People(n, weights(recipe), bare=bare)
            self.action_space = [gymnasium.spaces.Box(-np.inf, np.inf, (128,))] * n

        def __len__(self):
            return self.people.n

        @torch.no_grad()
        def reset(self, ids=None):
            ids = np.arange(len(self)) if ids is None else ids
            return self.people.reset(ids).numpy(), Batch(id=ids)

        @torch.no_grad()
        def step(self, actions, ids):
            obs, reward, ended = (x.numpy() for x in self.people.step(torch.as_tensor(actions)))
            return obs, reward, ended, np.zeros_like(ended), Batch(id=ids)

    return Vector(recipe["run"]["envs"])


def authors(recipe):
    import gymnasium
    import numpy as np
    import torch
    from motion_people import RANGE, People
    from shapely.geometry import LineString, Point, Polygon
    from tianshou.env import DummyVectorEnv

    def cast(people, eyes, rays):
        floor, box = (x[0].numpy() for x in people.edges()[0].split(4, 1))
        border, hits = Polygon(floor, [box]).boundary, torch.full(rays.shape[:3], RANGE)
        for t in range(2):
            eye = eyes[0, t].numpy()
            for k, ray in enumerate(rays[0, t].numpy()):
                hit = border.intersection(LineString([eye, eye + RANGE * ray]))
                hits[0, t, k] = RANGE if hit.is_empty else Point(eye).distance(hit)
        return hits

    class One(gymnasium.Env):
        action_space = gymnasium.spaces.Box(-np.inf, np.inf, (128,))
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (870,))
        shared = None

        @torch.no_grad()
        def reset(self, seed=None, options=None):
            if One.shared is None:
                One.shared = People(1, weights(recipe), copies=4, mesh=True, rays=cast)
            One.shared.state = dict(One.shared.state)
            obs = One.shared.reset(np.arange(1))[0].numpy()
            self.state = {name: value.clone() for name, value in One.shared.state.items()}
            return obs, {}

        @torch.no_grad()
        def step(self, action):
            # They share the arrays that never change.
            One.shared.state = self.state
            obs, reward, ended = One.shared.step(torch.as_tensor(action)[None])
            return obs[0].numpy(), float(reward), bool(ended), False, {}

    return DummyVectorEnv([One] * recipe["run"]["envs"])


def peer(arrangement, recipe, updates, threads):
    """Trains with Tianshou; seconds by the clock and of processor time of each update, and the rate of a matrix product."""
    import numpy as np
    import torch
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.policy import PPOPolicy
    from torch.distributions import Distribution, Independent, Normal

    torch.set_num_threads(threads)
    torch.manual_seed(0)
    np.random.seed(0)
    Distribution.set_default_validate_args(False)
    run, ppo, adam = recipe["run"], recipe["ppo"], recipe["adam"]
    actor, critic = network(recipe["policy"])
    learned = {id(p): p for p in [*actor.parameters(), *critic.parameters()]}
    # Tianshou takes any optimiser; the fused one is the fastest where torch has it for processors.
    fused = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 4)
    optim = torch.optim.AdamW(learned.values(), lr=adam["lr"], fused=fused or None)
    policy = PPOPolicy(
        actor, critic, optim, lambda mu, std: Independent(Normal(mu, std), 1), discount_factor=ppo["gamma"], gae_lambda=ppo["lambda"],
        eps_clip=ppo["clip"], vf_coef=ppo["value"], ent_coef=ppo["entropy"], max_grad_norm=ppo["max_grad_norm"],
        action_scaling=False, action_bound_method="",
    )  # fmt: skip
    steps = AUTHORS_STEPS if arrangement == "authors" else run["collect_steps"]
    envs = authors(recipe) if arrangement == "authors" else batched(recipe, arrangement == "bare")
    collector = Collector(policy, envs, VectorReplayBuffer(steps, run["envs"]))
    clock = lambda: (time.perf_counter(), time.process_time())
    marks, collecting = [clock()], []
    for _ in range(updates + 1):
        collector.collect(n_step=steps)
        collecting.append(time.perf_counter() - marks[-1][0])
        policy.update(0, collector.buffer, batch_size=ppo["batch"], repeat=ppo["passes"])
        collector.reset_buffer(keep_statistics=True)
        marks.append(clock())
    wall, cpu = (b - a for a, b in zip(marks[1], marks[-1]))
    share = sum(collecting[1:]) / wall
    return {"wall": steps * updates / wall, "cpu": steps * updates / cpu, "collect": share}


def product(threads):
    """GFLOP/s of the best of some square products of 32-bit floats."""
    import torch

    torch.set_num_threads(threads)
    a, b, best = torch.randn(2048, 2048), torch.randn(2048, 2048), float("inf")
    for _ in range(12):
        start = time.perf_counter()
        a @ b
        best = min(best, time.perf_counter() - start)
    return {"gflops": 2 * 2048**3 / best * 1e-9}


def here(train, name, updates, steps, threads):
    """The same of `train`."""

    def run(updates):
        with tempfile.TemporaryDirectory() as folder:
            only = ["run.epoch_steps=%d" % steps, "run.epochs=%d" % updates, "test.every=9999", "test.episodes=1", "checkpoint.every=9999",
                "env_options.task.latents=128", "env_options.task.body_every=1", "policy.obs_norm=false"]
            command = [train, name, "--threads", str(threads), "--out", f"{folder}/run", *(x for set_ in only for x in ("--set", set_))]
            before = sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                sys.exit(done.stderr)
            cpu = sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2]) - before
            return cpu, list(csv.DictReader(open(f"{folder}/run/timing.csv")))[1:]

    (short, _), (long, rows) = run(1), run(updates + 1)
    total = lambda column: sum(float(row[column]) for row in rows)
    wall = total("collect_seconds") + total("learn_seconds")
    best = min(float(row["collect_seconds"]) + float(row["learn_seconds"]) for row in rows)
    share = total("collect_seconds") / wall
    return {"wall": steps * updates / wall, "best": steps / best, "cpu": steps * updates / (long - short), "collect": share}


def operations(policy, passes, asks_prior):
    """Multiplications and additions of one environment step, as this project computes it: no value twice, no product with a zero state."""
    gru, n = policy["gru"], 4 * policy["octaves"]
    encoded = gru["state"] + gru["egosensing"] + n
    width = policy.get("trunk", encoded)
    recurrent = sum(3 * h * (2 * i + h) for h, i in ((gru["state"], 402), (gru["egosensing"], 32)))
    forward = recurrent + (encoded * width if "trunk" in policy else 0) + 4 * policy["blocks"] * width**2 + 257 * width
    # Learning: forward, and backward twice that but for the inputs, which need no gradient.
    learning = 3 * forward - sum(6 * h * i for h, i in ((gru["state"], 402), (gru["egosensing"], 32)))
    hidden = 3 * 256 * (2 * 201 + 256) + 3 * 256 * 384 + 2 * 256 * 512 + 256 * 256
    decoder = hidden + 18 * (3 * 256 * (201 + 256) + 2 * 256 * 512 + 256 * 201)
    regressor = 18 * (211 * 128 + 3 * (20 * 128**2 + 128 * 159) + 2 * 159 * 128)
    prior = 20 * (63 * 512 + 512**2 + 512 * 32) if asks_prior else 0
    return 2 * (forward + passes * learning + decoder + regressor + prior)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("recipe", choices=["paper", "quick"])
    parser.add_argument("--authors", action="store_true", help="also as the authors arrange it (minutes a round)")
    parser.add_argument("--ceiling", action="store_true", help="only this project and the product")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--updates", type=int, default=6, help="updates that count in a round")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--train", default=str(ROOT / "target/release/train"))
    parser.add_argument("--peer", help=argparse.SUPPRESS)
    args = parser.parse_args()
    recipe = tomllib.loads((ROOT / f"train/recipes/{args.recipe}.toml").read_text())
    if args.peer:
        done = product(args.threads) if args.peer == "product" else peer(args.peer, recipe, args.updates, args.threads)
        return print(json.dumps(done))
    threads = os.environ | dict.fromkeys(["OMP_NUM_THREADS", "MKL_NUM_THREADS"], str(args.threads))

    def other(name, updates):
        command = [sys.executable, __file__, args.recipe, "--peer", name, "--updates", str(updates), "--threads", str(args.threads)]
        return json.loads(subprocess.run(command, env=threads, stdout=subprocess.PIPE, check=True).stdout)

    runs = {name: [] for name in ["here"] + ["batched", "bare"] * (not args.ceiling) + ["authors"] * args.authors}
    for i in range(args.rounds):
        for name, results in runs.items():
            if name == "here":
                before = other("product", 0)["gflops"]
                result = here(args.train, args.recipe, args.updates, recipe["run"]["collect_steps"], args.threads)
                results.append(result | {"gflops": [before, other("product", 0)["gflops"]]})
            else:
                results.append(other(name, 1 if name == "authors" else args.updates))
            print(f"round {i} {name}: {results[-1]}", file=sys.stderr)
    report(runs, operations(recipe["policy"], recipe["ppo"]["passes"], weights(recipe)["pose"] != 0))


def report(runs, flop):
    print("| | steps/s, best | collecting | times faster here by the clock: median (least to most) | by processor time |")
    print("|---|---|---|---|---|")
    for name, results in runs.items():
        row = [name, f"{max(r['wall'] for r in results):.0f}", f"{100 * statistics.median(r['collect'] for r in results):.0f} %"]
        for key in ("wall", "cpu") if name != "here" else ():
            ratios = [a[key] / b[key] for a, b in zip(runs["here"], results)]
            row.append(f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")
        print("| " + " | ".join(row + [""] * (5 - len(row))) + " |")
    here = runs["here"]
    shares = [100e-9 * flop * r["best"] / statistics.mean(r["gflops"]) for r in here]
    best, peak = 1e-9 * flop * max(r["best"] for r in here), max(max(r["gflops"]) for r in here)
    print(f"\n{flop * 1e-6:.0f} MFLOP a step here: {statistics.median(shares):.0f} % ({min(shares):.0f} to {max(shares):.0f}) of the rate of the product", end="")
    print(f" before and after; best against best {best:.0f} of {peak:.0f} GFLOP/s, {100 * best / peak:.0f} %")


if __name__ == "__main__":
    main()
