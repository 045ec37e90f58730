"""The one kind of error that is the person's to mend."""


class InputError(ValueError):
    """What was given cannot be used.

    The message is one sentence or two: what is wrong, what was expected, what to do. The command
    line prints it alone, without a traceback, and exits with code 2.
    """
