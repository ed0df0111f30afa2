import pytest

from learning import ActorCritic, BatchQLearning, QLearning
from learning.algorithm import algorithms, load_algorithm
from learning.errors import AlgorithmLookupError


def test_the_shipped_algorithms_are_registered():
    assert set(algorithms()) >= {"actor-critic", "batch-q-learning", "q-learning"}
    assert load_algorithm("actor-critic") is ActorCritic
    assert load_algorithm("batch-q-learning") is BatchQLearning
    assert load_algorithm("q-learning") is QLearning


def test_an_unknown_algorithm_is_named_with_a_suggestion():
    with pytest.raises(AlgorithmLookupError, match="did you mean 'actor-critic'"):
        load_algorithm("actor-critics")
