"""The error for unusable input."""


class InputError(ValueError):
    """Input that pansplat cannot use.

    The message names the file or argument, what was needed, what was given, and what to do. Commands print it
    without a traceback and exit with status 2.
    """
