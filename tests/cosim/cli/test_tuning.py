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


def test_table_names_the_active_constraint(cosim):
    code, out, _ = cosim("tuning", "--scenario", "fast-sampling")
    assert code == 0
    assert "X2 ≥ 25 % (multiplier 60.29)" in out


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


def test_unwritable_file_is_one_line_of_error(cosim, tmp_path):
    code, _, err = cosim("tuning", "--out", tmp_path / "missing" / "tuned.toml")
    assert code == 2
    assert err.splitlines()[-1].startswith("error: ")
