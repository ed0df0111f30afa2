"""Errors of the learning package; each message names the mistake and its place."""

from cosim.core.errors import CosimError


class LearningError(CosimError):
    """Base of all errors that the package raises."""


class ConfigurationError(LearningError):
    """A hyperparameter has an unknown name or a value out of its range."""


class CheckpointError(LearningError):
    """A checkpoint is missing, damaged, or belongs to another run."""


class AlgorithmLookupError(LearningError):
    """No algorithm of this name is registered, or its entry point cannot be loaded."""


class DivergenceError(LearningError):
    """Learning diverged: θ has left the region where the QP is of use; the last good θ is kept."""


class PrivilegeError(LearningError):
    """An algorithm that requires a plant in operation used a simulator's abilities."""
