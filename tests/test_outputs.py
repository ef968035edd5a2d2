"""Results are complete, or not there."""

import re

import pytest

from coachable.outputs import complete_file, complete_folder


def files_in(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_folder_gets_its_files_at_the_end_and_keeps_others(tmp_path):
    out = tmp_path / "a" / "report"
    out.mkdir(parents=True)
    (out / "old.txt").write_text("old")
    (out / "new.txt").write_text("old")
    with complete_folder(out) as folder:
        (folder / "new.txt").write_text("new")
        (folder / "deeper").mkdir()
        (folder / "deeper" / "table.csv").write_text("1")
        assert (out / "new.txt").read_text() == "old"
    assert files_in(out) == ["deeper", "deeper/table.csv", "new.txt", "old.txt"]
    assert (out / "new.txt").read_text() == "new"


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, ValueError])
def test_nothing_is_left_of_what_was_interrupted(tmp_path, interruption):
    with pytest.raises(interruption), complete_folder(tmp_path / "report") as folder:
        (folder / "half.csv").write_text("1,")
        raise interruption
    with pytest.raises(interruption), complete_file(tmp_path / "film.gif") as file:
        file.write_text("half")
        raise interruption
    assert files_in(tmp_path) == []


def test_a_file_is_replaced_at_the_end(tmp_path):
    out = tmp_path / "a" / "film.gif"
    with complete_file(out) as file:
        assert file.suffix == ".gif"
        file.write_text("film")
        assert not out.exists()
    assert files_in(tmp_path) == ["a", "a/film.gif"]


def test_what_cannot_be_written_is_said_in_a_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    for complete, name, message in [
        (complete_folder, "file", "is a file: expected a folder"),
        (complete_folder, "file/report", "cannot write .*: Not a directory"),
        (complete_file, ".", "is a folder: expected the name of a file"),
        (complete_file, "file/film.gif", "cannot write .*film.gif: File exists"),
    ]:
        with pytest.raises(OSError, match=re.compile(message)), complete(tmp_path / name):
            raise AssertionError("nothing is given to write to")
