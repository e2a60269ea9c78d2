"""The root of the project's errors, and the one that this package raises."""


class ClosedLoopError(Exception):
    """Root of every error that the project raises on purpose: catching it catches them all."""


class ModelError(ClosedLoopError, ValueError):
    """A robot model is at fault, or the request for one is.

    The text is one line: what is wrong, where (link or joint, and file), and what would be right.
    """
