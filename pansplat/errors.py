"""The error for unusable input, and the warning for input of which a part is ignored."""


class InputError(ValueError):
    """Input that pansplat cannot use.

    The message names the file or argument, what was needed, what was given, and what to do. Commands print it
    without a traceback and exit with status 2.
    """


class InputWarning(UserWarning):
    """Input that pansplat can use in part. Commands print it as one line `note: ...`."""
