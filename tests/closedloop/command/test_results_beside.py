"""Where results go if no folder is named: beside those of other inputs, and not where another run is being written."""

import errno
import os

import closedloop as cl
from closedloop.base.files import FolderLock
from closedloop.command.results import TakenError, first_free

SHORT = ("planar2_slide", "--time.duration", "0.02", "--no-figures")
QUESTION = {"scenario": ""}


def test_another_question_goes_beside_the_first(command_line, tmp_path):
    """The last line names the folder and what is in the first; the same question finds its own folder again."""
    assert command_line(*SHORT).out.splitlines()[-1].endswith("wrote out/planar2_slide/: run.nc, summary.json")
    said = "out/planar2_slide: holds another run: law.force is 10.0 there and 12.0 here"
    for _ in range(2):
        line = command_line(*SHORT, "--law.force", "12").out.splitlines()[-1]
        assert line.endswith(f"wrote out/planar2_slide-2/: run.nc, summary.json; {said}")
    assert "wrote out/planar2_slide-3/" in command_line(*SHORT, "--law.force", "13").out
    forces = [
        cl.load_run(tmp_path / "out" / f"planar2_slide{end}" / "run.nc").scenario.law.force for end in ("", "-2", "-3")
    ]
    assert forces == [10.0, 12.0, 13.0]


def test_a_scenario_whose_lists_are_filled_finds_its_own_folder_again(command_line):
    """A run file has an entry for each joint in its lists, also for a free block that the scenario leaves out."""
    short = ("push_block", "--time.duration", "0.002", "--no-figures")
    for _ in range(2):
        assert command_line(*short).out.splitlines()[-1].endswith("wrote out/push_block/: run.nc, summary.json")


def test_with_json_standard_error_names_the_folder(command_line, tmp_path):
    """A program that reads the summary is not disturbed."""
    (tmp_path / "out" / "planar2_slide").mkdir(parents=True)
    (tmp_path / "out" / "planar2_slide" / "summary.json").write_text("{}")
    outcome = command_line(*SHORT, "--json")
    assert outcome.err == (
        "closedloop: wrote out/planar2_slide-2/; out/planar2_slide: its summary.json is not that of a run\n"
    )
    assert outcome.out.startswith("{")


def test_overwrite_replaces_the_first(command_line, tmp_path):
    """As with a folder that is named."""
    assert command_line(*SHORT).status == 0
    assert command_line(*SHORT, "--law.force", "12", "--overwrite").status == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["planar2_slide"]


def test_runs_at_once_have_a_folder_each(command_line, tmp_path):
    """The same question too: which of two would be the one that was read?"""
    with first_free(tmp_path / "r", QUESTION, False) as first, first_free(tmp_path / "r", QUESTION, True) as second:
        assert (first.folder.name, second.folder.name) == ("r", "r-2")
        assert second.not_first == f"{tmp_path / 'r'}: another run is being written there"
        (first.folder / "x").touch()
        assert "another run is being written there" in command_line(*SHORT, "--out", "r", "--overwrite").refusal()
    assert [path.name for path in tmp_path.iterdir()] == ["r"]  # what was made for nothing is gone
    with first_free(tmp_path / "r", QUESTION, False) as again:
        assert again.folder.name == "r"


def test_a_folder_removed_while_it_is_locked_is_made_anew(tmp_path, monkeypatch):
    """The run that made it gave nothing, and ended between the making of the folder and the lock."""
    usual, removed = os.open, []

    def removing(path, *flags):
        file = usual(path, *flags)
        if not removed and os.path.isdir(path):
            removed.append(os.rmdir(path))
        return file

    monkeypatch.setattr("closedloop.base.files.os.open", removing)
    with first_free(tmp_path / "r", QUESTION, False) as results:
        assert results.folder.is_dir()
        assert FolderLock.of(results.folder) is None
    assert removed


def test_a_disk_without_locks_is_no_reason_to_refuse(tmp_path, monkeypatch):
    """Then nothing keeps two runs apart."""

    def refuse(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("closedloop.base.files.fcntl.flock", refuse)
    with first_free(tmp_path / "r", QUESTION, False) as first, first_free(tmp_path / "r", QUESTION, False) as second:
        assert first.folder == second.folder


def test_a_refusal_releases_the_folder(tmp_path):
    """Whoever was refused is in nobody's way."""
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "run.nc").write_text("mine")
    for _ in range(2):
        with first_free(tmp_path / "r", QUESTION, False) as results:
            assert results.folder.name == "r-2"
            assert not results.not_first.endswith("is being written there")
    lock = FolderLock.of(tmp_path / "r")
    assert lock is not None
    lock.release()
    assert issubclass(TakenError, cl.OutputError)
