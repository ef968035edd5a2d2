"""`coachable coach` on the command line."""

import sys

import pytest

from coachable.cli import main
from coachable.coach.server import make_server


def test_a_missing_agent_is_named_without_a_traceback(capsys, tmp_path, monkeypatch):
    pytest.importorskip("viser")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    assert main(["coach", "empty", "--port", "18280"]) == 2
    output = capsys.readouterr()
    assert "coaching empty at http://127.0.0.1:18280" in output.out
    assert "coachable coach: no checkpoint at empty" in output.err


def test_a_missing_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"pip install 'coachable\[ui\]' \(in a clone: "):
        make_server()
    assert main(["coach", "humanoid"]) == 2
    assert "coachable[ui]" in capsys.readouterr().err
