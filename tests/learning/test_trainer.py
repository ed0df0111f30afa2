"""What the trainer of `cosim study` refuses before a training begins."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cosim import Scenario
from cosim.study.protocols import Training
from learning.errors import ConfigurationError
from learning.trainer import Trainer


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": 3}, "training: seed is given by the study itself"),
        ({"validate_evry": 100}, "training: .*unexpected keyword argument 'validate_evry'"),
        ({"validate_every": "often"}, "training: .*str"),
    ],
)
def test_an_option_that_makes_no_run_is_one_line(options: dict, message: str) -> None:
    training = Training(
        algorithm="q-learning",
        scenario=Scenario.load("paper"),
        samples=1000,
        seed=0,
        settings={},
        start="naive",
        nmpc="rti",
        log_every=100,
        evaluate_every=100,
        checkpoint_every=100,
        evaluation_seeds=1,
        evaluation_steps=10,
    )
    Trainer().check(training)
    with pytest.raises(ConfigurationError, match=message):
        Trainer().check(replace(training, options=options))
