"""The server of the live view: missing, refused, on a free port, and silent."""

import socket
import sys

import pytest

from odomap.errors import InputError, MissingExtra
from odomap.views.liveserver import check_viewer, close_server, open_server


def test_what_is_missing_is_said_with_its_mend(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtra, match=r"pip install 'odomap\[view\]'"):
        check_viewer()
    with pytest.raises(MissingExtra):
        open_server()


@pytest.mark.parametrize(
    ("host", "port", "what"), [("192.0.2.1", 8080, "192.0.2.1"), ("127.0.0.1", 0, "65535")]
)
def test_no_such_place(host, port, what):
    pytest.importorskip("viser", reason="the live view needs viser")
    with pytest.raises(InputError, match=what):
        open_server(host, port)


def test_the_next_free_port_is_taken_and_nothing_said(capsys):
    pytest.importorskip("viser", reason="the live view needs viser")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server, url = open_server(port=port)
        try:
            found = int(url.rpartition(":")[2])
            assert port < found <= port + 100
            socket.create_connection(("127.0.0.1", found)).close()
            assert server.request_share_url() is None
        finally:
            close_server(server)
    with pytest.raises(OSError, match=r".*"):
        socket.create_connection(("127.0.0.1", found)).close()
    assert capsys.readouterr() == ("", "")
