"""The capability flags of the interfaces in FMI 2.0.5 and FMI 3.0.2, with their defaults."""

from __future__ import annotations

_FMI2 = (
    "needsExecutionTool",
    "canBeInstantiatedOnlyOncePerProcess",
    "canNotUseMemoryManagementFunctions",
    "canGetAndSetFMUstate",
    "canSerializeFMUstate",
    "providesDirectionalDerivative",
)
_FMI3 = (
    "needsExecutionTool",
    "canBeInstantiatedOnlyOncePerProcess",
    "canGetAndSetFMUState",
    "canSerializeFMUState",
    "providesDirectionalDerivatives",
    "providesAdjointDerivatives",
    "providesPerElementDependencies",
)
_OWN: dict[tuple[str, str], dict[str, str]] = {
    ("2", "model exchange"): {"completedIntegratorStepNotNeeded": "false"},
    ("2", "co-simulation"): {
        "canHandleVariableCommunicationStepSize": "false",
        "canInterpolateInputs": "false",
        "maxOutputDerivativeOrder": "0",
        "canRunAsynchronuously": "false",
    },
    ("3", "model exchange"): {
        "needsCompletedIntegratorStep": "false",
        "providesEvaluateDiscreteStates": "false",
    },
    ("3", "co-simulation"): {
        "canHandleVariableCommunicationStepSize": "false",
        "fixedInternalStepSize": "none",
        "maxOutputDerivativeOrder": "0",
        "recommendedIntermediateInputSmoothness": "0",
        "providesIntermediateUpdate": "false",
        "mightReturnEarlyFromDoStep": "false",
        "canReturnEarlyAfterIntermediateUpdate": "false",
        "hasEventMode": "false",
        "providesEvaluateDiscreteStates": "false",
    },
}


def default_flags(version: str, interface: str) -> dict[str, str]:
    """Flag → default of an interface, ``"co-simulation"`` or other; FMI 1.0 has no flags."""
    common = {"2": _FMI2, "3": _FMI3}.get(version[:1], ())
    return dict.fromkeys(common, "false") | _OWN.get((version[:1], interface), {})
