"""The server of a scene that still trains: what it serves, who counts as watching, how it ends."""

import json
import socket
import threading
import time
import urllib.error
import urllib.request

import pytest

from heatsplat.contracts import SceneError
from heatsplat.viewer import live
from heatsplat.viewer.live import LiveServer
from heatsplat.viewer.page import SCRIPTS, SOURCES


@pytest.fixture
def server():
    server = LiveServer("wall & <door>", "127.0.0.1", 0)
    yield server
    server.close()


def fetched(server, path="/"):
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}{path}", timeout=10) as answer:
        assert answer.headers["Cache-Control"] == "no-store"
        return answer.read().decode("utf-8")


def test_it_serves_the_newest_state_and_its_number(server):
    assert server.url == f"http://localhost:{server.port}"
    assert "Waiting for the first state" in fetched(server) and "wall &amp; &lt;door&gt;" in fetched(server)
    assert json.loads(fetched(server, "/status")) == {"run": server.run, "state": 0}
    for state in (1, 2):
        server.show(f"state {state} in °C", state)
        assert fetched(server) == f"state {state} in °C"
        assert json.loads(fetched(server, "/status?x=1"))["state"] == state


def test_what_keeps_the_first_state_away_is_told(server):
    server.tell(problem="none of the 3 Gaussians can be seen")
    assert "none of the 3 Gaussians can be seen" in fetched(server)


@pytest.mark.parametrize("path", ["/etc/passwd", "/../live.py", "/checkpoints/last.ckpt", "/status/"])
def test_it_serves_nothing_else(server, path):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        fetched(server, path)
    assert not server.watched(60.0)  # a request for something else is none of the page


def test_it_is_watched_for_a_while_after_a_request(server):
    assert not server.watched(60.0)
    fetched(server, "/status")
    assert server.watched(60.0)
    time.sleep(0.03)
    assert not server.watched(0.02)


def test_it_listens_on_this_machine_alone_unless_told_otherwise(server):
    assert server._http.server_address[0] == "127.0.0.1"


def test_a_port_that_is_taken_is_refused_with_the_key_and_the_remedy(server):
    with pytest.raises(
        SceneError, match=rf"callbacks\.live\.port={server.port}: another program .*callbacks\.live\.port=0"
    ):
        LiveServer("wall", "127.0.0.1", server.port)


def test_a_host_of_another_machine_is_refused():
    with pytest.raises(SceneError, match=r"callbacks\.live\.host=192\.0\.2\.1 is no address .* 127\.0\.0\.1"):
        LiveServer("wall", "192.0.2.1", 0)


def test_its_port_is_free_when_it_is_closed_and_its_thread_is_gone():
    first = LiveServer("wall", "127.0.0.1", 0)
    fetched(first)
    first.close()
    assert "live viewer" not in {thread.name for thread in threading.enumerate()}
    with pytest.raises(urllib.error.URLError):
        fetched(first)
    second = LiveServer("wall", "127.0.0.1", first.port)
    second.close()
    assert second.run != first.run


def test_the_end_waits_until_an_open_page_has_the_last_state(server, monkeypatch):
    monkeypatch.setattr(live, "LAST_LOOK_S", 20.0)
    server.show("last", 3)
    fetched(server, "/status")
    ended = threading.Thread(target=server.end, args=("Training has ended", 60.0))
    ended.start()
    time.sleep(0.1)
    assert ended.is_alive()
    assert json.loads(fetched(server, "/status"))["phase"] == "Training has ended"
    time.sleep(0.1)
    assert ended.is_alive()  # the page knows, but has not fetched the state
    fetched(server)
    ended.join(10.0)
    assert not ended.is_alive()


def test_the_end_waits_for_nobody_who_does_not_look_and_not_for_long(server, monkeypatch):
    start = time.monotonic()
    server.end("Training has ended", 60.0)
    assert time.monotonic() - start < 1.0
    monkeypatch.setattr(live, "LAST_LOOK_S", 0.2)
    server.show("last", 3)
    fetched(server, "/status")
    server.end("Training has ended", 60.0)
    assert time.monotonic() - start < 5.0


def test_a_browser_that_goes_away_leaves_no_traceback(server, capfd):
    server.show("x" * 20_000_000, 1)
    with socket.create_connection(("127.0.0.1", server.port)) as gone:
        gone.sendall(b"GET / HTTP/1.0\r\n\r\n")
        gone.recv(10)
        gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
    time.sleep(0.2)
    assert fetched(server, "/status")
    assert capfd.readouterr().err == ""


def test_a_page_from_a_file_has_nothing_of_the_live_one():
    assert "live.js" not in SCRIPTS and (SOURCES / "live.js").exists()
