import json
import os
import subprocess
import sys
from http.client import HTTPConnection

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from roboxim_core.errors import ConfigError
from roboxim_studio.serving.access import Access
from roboxim_studio.serving.site import Site


@pytest.fixture
def heard():
    return []


@pytest.fixture
def site(heard):
    site = Site(Access(), received=lambda page, message: heard.append((page, dict(message))))
    yield site
    site.close()


def get(site, path, **headers):
    connection = HTTPConnection("127.0.0.1", site.port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), answer.headers


def token(site):
    return site.url.rstrip("/").rpartition("/")[2]


def test_the_page_needs_the_token_and_asks_nothing_of_others(site):
    status, page, headers = get(site, f"/{token(site)}/")
    assert status == 200
    assert b'src="studio.js"' in page
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "http" not in headers["Content-Security-Policy"].replace(f"ws://127.0.0.1:{site.port}", "")
    assert headers["Referrer-Policy"] == "no-referrer"
    assert get(site, f"/{token(site)}/studio.js")[0] == 200
    for path in ("/", "/index.html", "/studio.js", "/x/", f"/{token(site)[:-1]}/", f"/{token(site)}x/"):
        assert get(site, path)[0] == 403, path
    for path in ("/../README.md", "/%2e%2e/%2e%2e/_viser.py", "/etc/passwd"):
        assert get(site, f"/{token(site)}{path}")[0] == 404, path


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:{port}", "Origin": "http://evil.example:{port}"},
        {"Origin": "http://evil.example"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "null"},
        {"Host": "["},
        {"Origin": "http://["},
    ],
)
def test_other_origins_and_names_are_refused_even_with_the_token(site, headers):
    headers = {name: value.format(port=site.port) for name, value in headers.items()}
    assert get(site, f"/{token(site)}/", **headers)[0] == 403


def test_a_tunnel_of_another_port_is_let_in(site):
    assert get(site, f"/{token(site)}/", Host="localhost:9000")[0] == 200


def test_sockets_need_the_token_and_the_own_origin(site, heard):
    base = f"ws://127.0.0.1:{site.port}"
    own = f"http://127.0.0.1:{site.port}"
    for url, origin in (
        (base, own),
        (f"{base}/control", own),
        (f"{base}/{token(site)}/control", "http://evil.example"),
        (f"{base}/{token(site)}", "http://evil.example"),
    ):
        with pytest.raises(InvalidStatus, match="403"), connect(url, origin=origin, subprotocols=["viser-v1.1.1"]):
            pass
    site.send(hint="drive")
    with connect(f"{base}/{token(site)}/control", origin=own) as socket:
        assert json.loads(socket.recv())["hint"] == "drive"
        for text in ("no json", "[1]", json.dumps({"key": "Space"}), "[" * 20_000):
            socket.send(text)
        site.send(hint="done")
        assert json.loads(socket.recv()) == {"hint": "done"}
        assert site.pages == 1
    assert (1, {"key": "Space"}) in heard


@pytest.mark.skipif(os.geteuid() != 0, reason="needs the superuser, to act as another user")
def test_another_user_of_the_machine_is_refused_even_with_the_token(site):
    ask = (
        "import encodings.idna, os, socket, sys; port, path, user = sys.argv[1:]\n"
        "os.setuid(int(user)); there = socket.create_connection(('127.0.0.1', int(port)), timeout=30)\n"
        "there.sendall(f'GET {path} HTTP/1.1\\r\\nHost: 127.0.0.1:{port}\\r\\n\\r\\n'.encode())\n"
        "print(there.recv(64).split()[1].decode())"
    )
    for user, status in ((65534, "403"), (os.geteuid(), "200")):
        python = [sys.executable, "-I", "-c", ask, str(site.port), f"/{token(site)}/", str(user)]
        answer = subprocess.run(python, capture_output=True, text=True, timeout=60, check=True).stdout
        assert answer.strip() == status, user


def test_no_client_can_open_a_public_tunnel(site):
    import viser._messages as messages

    handlers = site.viser._websock_server._incoming_handlers
    assert messages.ShareUrlRequest not in handlers
    assert messages.GuiUpdateMessage in handlers


def test_a_taken_port_is_named(site):
    with pytest.raises(ConfigError, match=f"port {site.port} is taken"):
        Site(Access(), site.port)
