"""The exception that stands for a mistake of the user's."""


class UserError(ValueError):
    """A mistake of the user's: a wrong name, value or file.

    Its text is one sentence that names the parameter or path and says what is allowed. The command line prints it
    alone, without a traceback, and ends with exit code 2.
    """
