"""The one exception that reaches a user as a sentence instead of a traceback."""


class LioJaxError(Exception):
    """A job cannot go on: the message names the file, topic or key at fault and says what to do.

    The command line prints it without a traceback and exits with status 1.
    """


class UsageError(LioJaxError):
    """The request itself is wrong (unknown key, impossible value): exit status 2."""
