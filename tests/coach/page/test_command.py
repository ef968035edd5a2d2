"""`coachable coach` on the command line."""

import json
import re
import socket
import sys
import urllib.request

import pytest

from coachable.cli import main
from coachable.coach.page import command
from coachable.coach.page.server import free_port, make_server, page_address
from coachable.coach.session.session import CoachSession
from tests.coach.echo_domain import echo_session


def test_a_missing_agent_is_named_without_a_traceback(capsys, tmp_path, monkeypatch):
    pytest.importorskip("viser")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    assert main(["coach", "empty", "--port", "18280"]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert "coachable coach: no checkpoint at empty" in output.err


def test_the_printed_address_answers(monkeypatch):
    pytest.importorskip("viser")
    monkeypatch.setattr(CoachSession, "open", lambda *_, **__: echo_session())
    monkeypatch.setattr(command, "wait", lambda: None)
    answers = []

    def say(text):
        if address := re.search(r"http://[\d.:]+", text):
            with urllib.request.urlopen(f"{address[0]}/api/space") as answer:
                answers.append((json.load(answer)["domain"], "in use" in text))

    command.serve("echo", say=say, port=0)
    assert answers == [("echo", False)]


def test_a_missing_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"pip install 'coachable\[ui\]' \(in a clone: "):
        make_server()
    assert main(["coach", "humanoid"]) == 2
    assert "coachable[ui]" in capsys.readouterr().err


@pytest.mark.parametrize("port", [99999, -1, 65536])
def test_an_impossible_port_is_named(port, capsys):
    assert main(["coach", "humanoid", f"--port={port}"]) == 2
    assert f"there is no port {port}: expected a number from 0 to 65535" in capsys.readouterr().err


def test_an_impossible_address_is_named(capsys):
    pytest.importorskip("viser")
    assert main(["coach", "humanoid", "--host", "203.0.113.7", "--port", "18281"]) == 2
    assert "coachable coach: cannot listen on 203.0.113.7, port 18281: " in capsys.readouterr().err


def test_the_last_port_is_in_use():
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.bind(("127.0.0.1", 65535))
        taken.listen()
        with pytest.raises(OSError, match=r"no port from 65535 to 65535 is free on 127.0.0.1"):
            free_port("127.0.0.1", 65535)


@pytest.mark.parametrize("moment", ["while the server starts", "while the agent is loaded", "while it acts"])
def test_ctrl_c_ends_it(moment, capsys, monkeypatch):
    pytest.importorskip("viser")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    session = echo_session()
    monkeypatch.setattr(CoachSession, "open", lambda *_, **__: session)
    if moment == "while the server starts":
        monkeypatch.setattr("coachable.coach.page.server.make_server", interrupt)
    elif moment == "while the agent is loaded":
        monkeypatch.setattr(CoachSession, "open", interrupt)
    else:
        monkeypatch.setattr(command, "wait", interrupt)
    assert main(["coach", "humanoid", "--port", "18282"]) == 0
    output = capsys.readouterr()
    assert output.out.endswith("ended\n") and output.err == ""
    if moment == "while it acts":
        assert session.env.is_closed
        assert free_port("127.0.0.1", 18282) == 18282, "the page is gone"
    session.close()


def test_addresses_for_a_browser():
    assert page_address("127.0.0.1", 80) == "http://127.0.0.1:80"
    assert {page_address(host, 80) for host in ("", "*", "0.0.0.0", "::")} == {"http://localhost:80"}
    assert page_address("::1", 80) == "http://[::1]:80"
