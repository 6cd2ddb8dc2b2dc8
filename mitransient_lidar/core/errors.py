"""The error for invalid user input, text for terminals, and recognition of interruptions and exhausted memory."""

import re

#: Characters that steer a terminal or change its display order: C0 and C1 controls, DEL, writing direction marks, line
#: separators; and lone surrogates, which represent file name bytes that are no text.
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")

LINES = "\n\t"  #: Controls that a text with several lines keeps.

#: Longest message, and the parts at its ends that are kept of a longer one, in characters.
_LONGEST, _BEGINNING, _END = 2000, 1500, 400


def printable(text: str, kept: str = "") -> str:
    r"""Return a text whose control characters, but those `kept`, are written as ``\x1b`` or ``\u202e``."""
    return _CONTROLS.sub(lambda one: one[0] if one[0] in kept else ascii(one[0])[1:-1], text)


class UserError(ValueError):
    """Invalid user input: a wrong name, value or file.

    Its message is one sentence that names the parameter or path, its value, and the allowed values. It is `printable`,
    and beyond 2000 characters its middle is left out. The command line prints it without a traceback and exits with
    code 2.
    """

    def __init__(self, message: str = "") -> None:
        text = printable(message)
        super().__init__(text if len(text) <= _LONGEST else f"{text[:_BEGINNING]} ... {text[-_END:]}")


class WriteError(UserError):
    """A file that cannot be written, for want of space or permission."""


def is_interruption(error: BaseException) -> bool:
    """Return whether an exception is a Ctrl-C, or one that Mitsuba or Dr.Jit has wrapped in a ``RuntimeError``."""
    wrapped = "KeyboardInterrupt" in str(error) or isinstance(error.__cause__, KeyboardInterrupt)
    return isinstance(error, KeyboardInterrupt) or (isinstance(error, RuntimeError) and wrapped)


def raise_if_out_of_memory(error: BaseException) -> None:
    """Raise `UserError` for an exception by Python, NumPy or Dr.Jit when memory runs out."""
    if isinstance(error, MemoryError) or re.search(r"out of memory|(?i:jit)_malloc|bad_alloc", str(error)):
        reason = " ".join(str(error).split()) or "no detail is known"
        raise UserError(
            f"memory ran out ({reason[:120]}): use fewer bins, pixels or paths_per_pass, or a smaller max_memory"
        ) from error
