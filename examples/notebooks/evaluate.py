"""Compare controllers on the same disturbances. Open it as a notebook."""

# %% Three controllers, the same noise for all
from pathlib import Path

from cosim import evaluate

SEEDS, STEPS = 10, 500
out = Path("notebook-evaluate")
out.mkdir(exist_ok=True)
table = evaluate("fouled", ["naive", "tuned", "optimal"], seeds=SEEDS, steps=STEPS)
table.figure()

# %% The figures with their 95 % intervals
for name, row in table.summary()["controllers"].items():
    low, high = row["intervals"]["J"]["t"]
    print(f"{name}: J {row['J']:.1f} [{low:.1f}, {high:.1f}], {row['violating_share']:.1%} violate")

# %% Files: evaluation.csv, evaluation.png, timing.csv
table.write(out)
