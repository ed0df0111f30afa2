"""Data of a plant that is the nominal model with other parameters, and a model of it."""

from learning.empirical_model import EmpiricalModel, EmpiricalModelConfiguration

SETTINGS = EmpiricalModelConfiguration.from_dict({})


def plant_data(features, rng, count, error, offset=0.0):
    """Inputs about the steady state and outputs of a plant whose parameter errors are `error`."""
    inputs = rng.normal([27.0, 60.0, 220.0, 230.0], [2.0, 6.0, 20.0, 20.0], (count, 4))
    y, _, h = features(inputs, error)
    noise = rng.uniform(-0.1, 0.1, y.shape)
    return inputs, y + h * (noise + offset)


def fit(features, inputs, outputs):
    """The model of some transitions."""
    return EmpiricalModel.fit(features, inputs, outputs, SETTINGS)
