"""What can go wrong."""


class RowgramError(Exception):
    """Any error of rowgram."""


class InputError(RowgramError, ValueError):
    """A file, option, array or project cannot be used as given; the message says what was expected."""


class NothingToDoError(InputError):
    """The project has no input for this stage."""


class SolverError(RowgramError, ArithmeticError):
    """An optimisation could not be started or had to be abandoned."""


class IncompleteError(RowgramError):
    """The work could not be completed, or a quality check failed."""


class InternalError(RowgramError):
    """A fault of rowgram itself; please report it with what led to it."""


class RowgramWarning(UserWarning):
    """Something was left out, assumed or is doubtful. The attribute `diagnostic` has it in parts."""

    def __init__(self, message: str, diagnostic: "dict[str, object] | None" = None) -> None:
        super().__init__(message)
        self.diagnostic = diagnostic or {}
