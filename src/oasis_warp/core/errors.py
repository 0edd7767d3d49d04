"""The error for users."""


class InputError(ValueError):
    """Invalid input of the user; the message is one sentence: where, what is wrong, what to do.

    The command line prints it without a traceback and exits with code 2.
    """
