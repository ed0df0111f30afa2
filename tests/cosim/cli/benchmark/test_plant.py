import json

REFERENCES = [
    "fmpy's convenience methods",
    "simulate_fmu",
    "simulate_fmu, kept instance",
    "simulate_fmu, open loop",
]


def test_a_step_is_set_beside_what_fmpy_offers_and_reset_beside_a_step(cosim):
    code, out, err = cosim("benchmark", "plant", "--steps", 200, "--json")
    assert code == 0, err
    rows = json.loads(out)["rows"]
    step, others = rows[: len(REFERENCES)], rows[len(REFERENCES) :]
    assert [(row["name"], row["reference"]) for row in step] == [
        ("FmuPlant.step", reference) for reference in REFERENCES
    ]
    assert [(row["name"], row["reference"]) for row in others] == [
        ("reset", "FmuPlant.step"),
        ("snapshot and restore", "FmuPlant.step"),
    ]
    assert all(row["median_us"] > 0 and row["ratio"] > 0 for row in rows)
