"""The root of the project's errors, and the one that this package raises."""


class ClosedLoopError(Exception):
    """Root of every error that the project raises on purpose: catching it catches them all."""


# Characters of a message. Long enough for two paths and a list of names.
_LONG = 600


class ModelError(ClosedLoopError, ValueError):
    """A robot model is at fault, or the request for one is.

    The text is one line: what is wrong, where (link or joint, and file), and what would be right. Of a text that
    quotes something very long the middle is left out.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text if len(text) <= _LONG else f"{text[: _LONG - 200]} … {text[-150:]}")
