"""Work in a second process: its result, whatever becomes of the process."""

import os

import pytest

from closedloop.base.second_process import Beside, possible


def test_its_result_is_that_of_the_work():
    """Where a second process is possible the work is done in one."""
    beside, here = Beside(os.getpid), possible()
    assert (beside.result() != os.getpid()) == here


def test_work_that_cannot_be_done_there_is_done_here(capfd):
    """Nothing is printed twice, and what the work raises is raised where its result is wanted."""
    home = os.getpid()

    def only_here():
        print("at work")
        if os.getpid() != home:
            raise RuntimeError("not here")
        return "done"

    def nowhere():
        raise KeyError("nowhere")

    assert Beside(only_here).result() == "done"
    assert capfd.readouterr().out == "at work\n"
    with pytest.raises(KeyError, match="nowhere"):
        Beside(nowhere).result()


def test_a_process_that_was_killed_leaves_nothing_undone():
    """Of a process that ends without a word the work is done again; one that is stopped is gone."""
    home = os.getpid()
    assert Beside(lambda: "done" if os.getpid() == home else os._exit(9)).result() == "done"
    unwanted = Beside(lambda: None)
    unwanted.stop()
    assert unwanted._process is None
