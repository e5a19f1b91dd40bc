"""The error that a user can cause and mend."""


class UserError(Exception):
    """Bad configuration, a missing or corrupt file, the wrong robot: one line that says what and what to do.

    Commands print it without a traceback and exit with code 2.
    """
