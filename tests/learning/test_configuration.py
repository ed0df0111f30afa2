import pytest

from learning import ActorCritic, BatchQLearning, QLearning
from learning.errors import ConfigurationError

CLASSES = (QLearning, BatchQLearning, ActorCritic)


@pytest.mark.parametrize("cls", CLASSES)
def test_every_hyperparameter_is_documented_and_has_a_default(cls):
    for name, default, meaning in cls.Configuration.documentation():
        assert meaning, name
        assert "Undefined" not in default, name


def test_assignments_are_read_as_toml_and_bare_words_as_text():
    found = QLearning.Configuration.from_assignments(
        ["rule=fit", "step_size=1e-3", "scaled=false", "exploration_deviation=[3.0, 4.0]"]
    )
    assert (found.rule, found.step_size, found.scaled) == ("fit", 1e-3, False)
    assert found.exploration_deviation == (3.0, 4.0)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("gain", "write name=value"),
        ("gian=0.1", "did you mean 'gain'"),
        ("gain=-1", "gain"),
        ("gain=nan", "gain"),
        ("rule=newton", "rule.*td"),
        ("memory=many", "memory"),
        ("line_search=true", "line_search: has no part in the rule kalman"),
    ],
)
def test_a_bad_assignment_gets_one_clear_message(assignment, message):
    with pytest.raises(ConfigurationError, match=message):
        QLearning.Configuration.from_assignments([assignment])


def test_an_option_of_another_rule_is_refused_and_its_default_is_not():
    with pytest.raises(ConfigurationError, match="memory: has no part in the rule fit"):
        QLearning.Configuration.from_dict({"rule": "fit", "memory": 10.0})
    QLearning.Configuration.from_dict({"rule": "fit", "memory": 4000.0})


@pytest.mark.parametrize("cls", CLASSES)
def test_a_configuration_survives_json(cls):
    configuration = cls.Configuration()
    assert cls.Configuration.from_dict(configuration.model_dump(mode="json")) == configuration
