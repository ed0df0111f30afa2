"""A small study: two rules, two seeds, one scenario. Open it as a notebook."""

# %% What is compared with what; the same as a file is docs/how-to/study.md
from cosim import study

SAMPLES = 5000
document = {
    "schema": 1,
    "name": "notebook",
    "scenarios": ["fouled"],
    "training_seeds": {"first": 0, "count": 2},
    "evaluation": {"first_seed": 100000, "seeds": 4, "steps": 200},
    "curves": {"points": 4, "seeds": 2, "steps": 100},
    "case": [
        {"controller": ["naive", "tuned"]},
        {"name": "q", "algorithm": "q-learning", "samples": SAMPLES},
        {"name": "batch", "algorithm": "batch-q-learning", "samples": SAMPLES},
    ],
}
results = study(document, "notebook-study")

# %% The table, least regret first
print(results.table("fouled"))

# %% One page with tables, learning curves and profiles
print(results.report())
