"""Instances in every state of the standards' state machines, and the check of one call there."""

import re
from collections.abc import Callable

import pytest
from fmpy.fmi1 import FMICallException

DISCARD, ERROR = 2, 3
# (state, whether the instance is for model exchange)
STATES = [
    ("instantiated", False), ("initialization", False), ("step", False), ("terminated", False),
    ("instantiated", True), ("initialization", True), ("event", True), ("continuous", True),
    ("terminated", True),
]  # fmt: skip


@pytest.fixture(params=STATES, ids=lambda p: p[0] + (" exchange" if p[1] else ""))
def state(request: pytest.FixtureRequest) -> tuple[str, bool]:
    return request.param


@pytest.fixture
def complaint(open_fmu) -> Callable[..., list[str]]:
    """Call a function in a state: it must succeed without a message, or log one error."""

    def bring_to(version: int, name: str, exchange: bool):
        instance = open_fmu(version, exchange=exchange)
        if name == "instantiated":
            if version == 2:
                instance.fmu.setupExperiment()
            return instance
        instance.enter_initialisation()
        if name == "initialization":
            return instance
        instance.fmu.exitInitializationMode()
        if name == "continuous":
            instance.start_continuous_time()
        if name == "terminated":
            instance.fmu.terminate()
        return instance

    def check(
        version: int, function: str, state: tuple[str, bool], arguments, allowed: bool
    ) -> list[str]:
        instance = bring_to(version, *state)
        status = getattr(instance.fmu.dll, function)(instance.handle, *arguments)
        logged = [message[0] for message in instance.messages]
        if allowed:
            right = status == 0 and not logged
        else:
            right = status == ERROR and logged == [ERROR] and function in instance.messages[0][2]
        verdict = "is allowed" if allowed else "is refused"
        said = f"status {status}, messages {instance.messages}"
        return [] if right else [f"{function} {verdict} when {state[0]}, but: {said}"]

    return check


@pytest.fixture
def refused() -> Callable[..., tuple[int, str]]:
    """Make a call that must fail; returns its status and the one message that it logs."""

    def call_refused(instance, call: Callable[[], object]) -> tuple[int, str]:
        before = len(instance.messages)
        with pytest.raises(FMICallException) as caught:
            call()
        (status, category, text), *more = instance.messages[before:]
        assert not more
        assert status == caught.value.status
        assert category == {DISCARD: "logStatusDiscard", ERROR: "logStatusError"}[status]
        assert not re.search("[%#]", text)
        return status, text

    return call_refused
