"""The error for invalid user input, and recognition of interruptions."""


class UserError(ValueError):
    """Invalid user input: a wrong name, value or file.

    Its message is one sentence that names the parameter or path, its value, and the allowed values. The command line
    prints it without a traceback and exits with code 2.
    """


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception is a Ctrl-C, or one that Mitsuba or Dr.Jit has wrapped in a ``RuntimeError``."""
    wrapped = "KeyboardInterrupt" in str(error) or isinstance(error.__cause__, KeyboardInterrupt)
    return isinstance(error, KeyboardInterrupt) or (isinstance(error, RuntimeError) and wrapped)
