import pytest

from learning import ActorCritic, BatchQLearning, QLearning
from learning.algorithm import load_algorithm
from learning.errors import ConfigurationError
from learning.search import Search

CLASSES = (QLearning, BatchQLearning, ActorCritic, Search)


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
        ("prior_width", "write name=value"),
        ("prior_widht=0.1", "did you mean 'prior_width'"),
        ("prior_width=-1", "prior_width"),
        ("prior_width=nan", "prior_width"),
        ("rule=newton", "rule.*td"),
        ("step_every=many", "step_every"),
        ("step_size=0.1", "step_size: has no part in the rule kalman"),
    ],
)
def test_a_bad_assignment_gets_one_clear_message(assignment, message):
    with pytest.raises(ConfigurationError, match=message):
        QLearning.Configuration.from_assignments([assignment])


@pytest.mark.parametrize(
    ("algorithm", "assignment", "message"),
    [
        ("batch-q-learning", "parameter_drift=0.1", "no hyperparameter 'parameter_drift'"),
        ("search", "phase=100", "phase: has no part in a search without a rule"),
        ("backoff", "exploration_share=0.1", "exploration_share: has no part in a rule that tries"),
        (
            "policy-search",
            "smallest_eigenvalue=0.1",
            "smallest_eigenvalue: has no part in a rule that",
        ),
        ("q-learning", "block=4", "no hyperparameter 'block'"),
    ],
)
def test_what_acts_nowhere_is_refused(algorithm, assignment, message):
    with pytest.raises(ConfigurationError, match=message):
        load_algorithm(algorithm).Configuration.from_assignments(assignment.split())


@pytest.mark.parametrize("cls", CLASSES)
def test_a_configuration_survives_json(cls):
    configuration = cls.Configuration()
    assert cls.Configuration.from_dict(configuration.model_dump(mode="json")) == configuration
