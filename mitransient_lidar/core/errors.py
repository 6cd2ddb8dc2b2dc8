"""The error for invalid user input, and recognition of interruptions and of exhausted memory."""

import re


class UserError(ValueError):
    """Invalid user input: a wrong name, value or file.

    Its message is one sentence that names the parameter or path, its value, and the allowed values. The command line
    prints it without a traceback and exits with code 2.
    """


class DryBottomError(UserError):
    """A bottom that rises through the sea where the receiver looks."""


class WriteError(UserError):
    """A file that cannot be written, for want of space or permission."""


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception is a Ctrl-C, or one that Mitsuba or Dr.Jit has wrapped in a ``RuntimeError``."""
    wrapped = "KeyboardInterrupt" in str(error) or isinstance(error.__cause__, KeyboardInterrupt)
    return isinstance(error, KeyboardInterrupt) or (isinstance(error, RuntimeError) and wrapped)


def raise_if_out_of_memory(error: BaseException) -> None:
    """Raise `UserError` for an exception that says that memory ran out, of Python, NumPy or Dr.Jit."""
    if isinstance(error, MemoryError) or re.search(r"out of memory|(?i:jit)_malloc|bad_alloc", str(error)):
        reason = " ".join(str(error).split()) or "no detail is known"
        raise UserError(
            f"memory ran out ({reason[:120]}): use fewer bins, pixels or paths_per_pass, or a smaller max_memory"
        ) from error
