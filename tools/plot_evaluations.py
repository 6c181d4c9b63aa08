"""Draw the evaluations of some trainings: how far the car came, over what it had learned from."""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("runs", nargs="+", type=Path, help="folders of runs, with evaluations.npz")
parser.add_argument("--out", type=Path, default=Path("evaluations.png"))
args = parser.parse_args()
for run in args.runs:
    if not (run / "evaluations.npz").is_file():
        parser.error(f"'{run}' has no evaluations.npz; give the folder of a `sb3-torcs train`")

figure = Figure(figsize=(8.0, 1.2 + 1.1 * len(args.runs)), layout="constrained")
rows = figure.subplots(len(args.runs), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
for row, run in zip(rows, args.runs, strict=True):
    saved = np.load(run / "evaluations.npz")
    returns = saved["results"].mean(axis=1)
    best = returns.argmax()
    row.plot(saved["timesteps"], returns, color="tab:blue", marker="o", markersize=3)
    row.plot(saved["timesteps"][best], returns[best], color="tab:red", marker="o")
    row.set_title(f"{run}", fontsize=8, loc="left", pad=2)
    row.grid(alpha=0.3)
rows[-1].set_ylim(bottom=0.0)  # of all rows: they share the axis
rows[-1].set_xlabel("timesteps learned from")
figure.supylabel("return of the evaluation from the grid", fontsize=9)
figure.savefig(args.out, dpi=110)
print(f"{args.out}: the red point is the model that was kept")
