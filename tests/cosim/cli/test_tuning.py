"""`cosim tuning`: certificate and θ file."""

import json

from cosim.scenario import Scenario


def test_certificate_as_json(cosim):
    code, out, _ = cosim("tuning", "--scenario", "paper", "--json")
    document = json.loads(out)
    assert code == 0
    assert abs(document["active"]["X2 ≥ 25 %"] - 60.29) < 0.01
    assert document["economic_eigenvalues"][0] < 0 < document["convexified_eigenvalues"][0]
    assert document["gain_error"] < 1e-8


def test_tuned_parameters_are_a_controller(cosim, tmp_path):
    from controllers import factories

    path = tmp_path / "tuned.toml"
    code, _, err = cosim("tuning", "--out", path)
    assert code == 0
    assert str(path) in err.replace("\n", "")
    scenario = Scenario.load("paper")
    assert factories.from_file(scenario, path).parameters.hash == (
        factories.tuned(scenario).parameters.hash
    )
