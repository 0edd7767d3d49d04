"""The one error a user is meant to read."""


class InputError(ValueError):
    """Something the user gave cannot be used; the message is one sentence: what, where, what to do.

    The command line prints it without a traceback and exits with code 2.
    """
