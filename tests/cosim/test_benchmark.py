import json

COMPARED = {
    "FmuPlant.step",
    "fmpy convenience methods",
    "fmpy simulate_fmu",
    "fmpy simulate_fmu, kept instance",
    "fmpy simulate_fmu, open loop",
    "reset",
    "snapshot and restore",
}


def test_the_command_prints_medians_and_ratios(cosim):
    code, out, err = cosim("benchmark", "plant", "--steps", 200, "--json")
    assert code == 0, err
    result = json.loads(out)
    assert {row["name"] for row in result["rows"]} == COMPARED
    assert all(row["median_us"] > 0 for row in result["rows"])
