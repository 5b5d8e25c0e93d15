"""The one error that users see: what was wrong with what they gave us, and what to do about it."""


class InputError(ValueError):
    """Input that pansplat cannot use.

    The message names the file or argument, what was needed, what came, and what to do. Commands print it
    without a traceback and exit with status 2.
    """
