"""What is worked out once is one object, whoever asks."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

from robot_models.cached import cached


def test_threads_that_ask_at_once_get_one_object():
    """`functools.cache` gives each its own then: a surface's entry was compiled twice, and one of the two forgotten."""
    together = Barrier(4)

    @cached
    def made(name: str, sign: int = 1) -> object:
        """Return an object."""
        together.wait(10.0)
        return [name, sign]

    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(lambda _: made("a", sign=2), range(4))
    assert first == ["a", 2]
    assert all(each is first for each in [*others, made("a", sign=2)])
    assert made.__doc__ == "Return an object."
