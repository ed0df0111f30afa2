"""Errors whose message is meant for the user: the base of all, and those of FMUs."""


class CosimError(Exception):
    """Base of every error that the four packages raise on bad input or a failed run.

    Its text is one line, whatever a user's name or value in it holds.
    """

    def __str__(self) -> str:
        return " ".join(super().__str__().splitlines())


class FmuError(CosimError):
    """Base of every error that `fmus` raises for a bad input or environment."""


class BuildError(FmuError):
    """No usable C compiler, or the compiler refused the sources."""


class CheckError(FmuError):
    """The file to check is missing or is not an FMU."""
