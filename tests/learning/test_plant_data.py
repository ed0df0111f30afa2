"""The regimes of a plant."""

import numpy as np
import pytest

from learning.plant_data import PlantData
from tests.helpers.empirical import SETTINGS, plant_data


@pytest.mark.slow
def test_data_from_before_a_slow_change_are_dropped(features, rng):
    error, parts = np.zeros(features.n_parameters), []
    for _ in range(4):
        parts.append(plant_data(features, rng, 500, error.copy()))
        error[0] -= 0.01
    inputs, outputs = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    same = np.concatenate([parts[0][0]] * 4), np.concatenate([parts[0][1]] * 4)
    data = PlantData(features, SETTINGS)
    assert (data.outdated(inputs, outputs), data.outdated(*same)) == (750, 0)


def watched(features, fitted, rng, offset, **changes):
    """Data of 240 samples whose errors are offset from what the fitted model, or another, says."""
    error = -0.2 * np.eye(features.n_parameters)[0]
    inputs, outputs = plant_data(features, rng, 240, error, offset)
    data = PlantData(features, SETTINGS)
    rows = np.zeros((SETTINGS.memory, 7))
    rows[:240] = np.column_stack([inputs, outputs])
    model = {f"model.{name}": value for name, value in (fitted.state_dict() | changes).items()}
    data.load_state_dict(data.state_dict() | {"rows": rows, "count": 240} | model)
    return data


def test_so_few_independent_errors_show_no_change_however_many_samples(features, fitted, rng):
    seen = {}
    for persistence in (0.0, 0.9995):
        changes = {"persistence": persistence * np.eye(features.n_outputs)}
        data = watched(features, fitted, rng, 30.0, **changes)
        seen[persistence] = data.changed(data.predictions())
    assert seen == {0.0: True, 0.9995: False}


@pytest.mark.parametrize(("share", "seen"), [(1e-5, False), (1e-2, True)])
def test_an_output_without_errors_shows_no_change_by_its_rounding(features, rng, share, seen):
    """The cost is known exactly, and then a share of its standard deviation larger."""
    nominal = np.zeros(features.n_parameters)
    inputs, outputs = plant_data(features, rng, 240, nominal)
    y, _, _ = features(inputs, nominal)
    cost = y[:, -1]
    outputs[:, -1] = cost
    outputs[120:, -1] += share * cost.std()
    data = PlantData(features, SETTINGS)
    rows = np.zeros((SETTINGS.memory, 7))
    rows[:240] = np.column_stack([inputs, outputs])
    data.load_state_dict(data.state_dict() | {"rows": rows, "count": 120})
    data.fit()
    data.count = 240
    assert data.changed(data.predictions()) == seen


@pytest.mark.parametrize(("offset", "window"), [(0.0, 0), (0.3, 15)])
def test_a_change_of_the_plant_is_seen_and_its_absence_not(features, fitted, rng, offset, window):
    data = watched(features, fitted, rng, offset)
    assert data.changed(data.predictions()) == bool(window)
    assert data.age == (window or 240)
