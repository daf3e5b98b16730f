"""Inter-quartile means and stratified bootstrap intervals from rliable. Writes ../../fixtures/stats.json.

    python -m venv venv && venv/bin/pip install -r requirements.txt && venv/bin/python make.py
"""
import json
from pathlib import Path

import numpy as np
from rliable import library, metrics

TASKS, RUNS, RESAMPLES = 3, 9, 20_000


def iqm(scores):
    """`scores`: runs x tasks."""
    return float(metrics.aggregate_iqm(scores))


def interval(scores):
    # rliable draws from the generator that it is given and, within strata, from the global one.
    np.random.seed(1)
    _, ends = library.get_interval_estimates(
        {"it": scores}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=RESAMPLES, random_state=np.random.RandomState(1)
    )
    return [float(x) for x in ends["it"][:, 0]]


rng = np.random.default_rng(5)
# Tasks whose scores lie apart, so that it matters that each is resampled by itself; one of them with an outlier.
scores = rng.normal(size=(RUNS, TASKS)) * [1.0, 4.0, 0.5] + [0.0, 10.0, 3.0]
scores[2, 0] = -20.0
each = [scores[:, [k]] for k in range(TASKS)]
fixture = {
    "scores": scores.T.tolist(),
    "mean": iqm(scores),
    "task_means": [iqm(s) for s in each],
    "interval": interval(scores),
    "task_intervals": [interval(s) for s in each],
}
path = Path(__file__).parent / "../../fixtures/stats.json"
path.write_text(json.dumps(fixture, indent=1) + "\n")
