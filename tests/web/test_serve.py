"""Pages on the local network: real requests by https, the QR code, the end by Ctrl+C."""

import http.client
import signal
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509

from pansplat.cli import run
from pansplat.export import page_server as serve_module
from pansplat.export.page import write_page
from pansplat.export.page_server import PageServer, make_certificate
from pansplat.gaussians.scene import Scene
from pansplat.pipeline import save


@pytest.fixture
def server(plain_scene: Scene, tmp_path: Path) -> Iterator[PageServer]:
    """A page in two files beside another file."""
    (tmp_path / "secret.html").write_text("not for others")
    with PageServer(write_page(plain_scene, tmp_path / "our home.html", split=True)) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield server
        server.shutdown()


def ask(server: PageServer, path: str, method: str = "GET") -> tuple[int, http.client.HTTPMessage, bytes]:
    """Status, headers and content; the certificate must be valid for the address."""
    port = server.server_address[1]
    context = ssl.create_default_context(cadata=ssl.get_server_certificate(("127.0.0.1", port)))
    connection = http.client.HTTPSConnection("127.0.0.1", port, context=context, timeout=30)
    connection.request(method, path)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, answer.headers, content


def test_the_page_and_its_parts_are_served_and_nothing_else(server: PageServer, tmp_path: Path) -> None:
    page = (tmp_path / "our home.html").read_bytes()
    for path in ("/", "/our%20home.html", "/?from=qr"):
        status, headers, content = ask(server, path)
        assert (status, headers["Content-Type"], content) == (200, "text/html; charset=utf-8", page)
    part, *_ = (tmp_path / "our home_files").iterdir()
    status, headers, content = ask(server, f"/our%20home_files/{part.name}")
    assert (status, headers["Content-Type"], content) == (200, "application/octet-stream", part.read_bytes())
    assert b'"our%20home_files"' in page and f'"{part.name}"'.encode() in page
    wrong = (
        "secret.html",
        "our%20home_files/",
        "../secret.html",
        "our%20home_files/../secret.html",
        "/etc/passwd",
        "[::1",
    )
    for path in map("/{}".format, wrong):
        status, _, content = ask(server, path)
        assert status == 404 and b"not for others" not in content
    assert ask(server, "/", "HEAD")[::2] == (200, b"")
    assert ask(server, "/", "POST")[0] == 501
    part.unlink()
    assert ask(server, f"/our%20home_files/{part.name}")[0] == 404


def test_every_answer_forbids_frames_and_guesses_of_types(server: PageServer) -> None:
    for path, method, status in (("/", "GET", 200), ("/", "HEAD", 200), ("/none", "GET", 404), ("/", "POST", 501)):
        found, headers, _ = ask(server, path, method)
        assert found == status and headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"


def test_a_client_that_sends_nothing_or_plain_http_does_not_stop_others(server, capfd) -> None:
    port = server.server_address[1]
    with socket.create_connection(("127.0.0.1", port)), socket.create_connection(("127.0.0.1", port)) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert not plain.recv(1000).startswith(b"HTTP")
        assert ask(server, "/")[0] == 200
    assert capfd.readouterr() == ("", "")


def test_the_certificate_names_the_address_and_is_not_an_authority(monkeypatch: pytest.MonkeyPatch) -> None:
    certificate = x509.load_pem_x509_certificate(make_certificate("192.168.1.20"))
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(name.value) for name in names] == ["192.168.1.20", "127.0.0.1", "localhost"]
    assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert (certificate.not_valid_after_utc - certificate.not_valid_before_utc).days == 31
    monkeypatch.setattr(serve_module, "_ELSEWHERE", ("no address", 9))
    assert serve_module.find_address() == "127.0.0.1", "that of the machine, without a network"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_export_serves_until_a_signal(plain_scene, tmp_path, monkeypatch, capsys, number: int) -> None:
    save(plain_scene, tmp_path / "scene.ply")
    monkeypatch.setattr(PageServer, "serve_forever", lambda server: signal.raise_signal(number))
    arguments = ["export", tmp_path / "scene.ply", "--serve", "-o", tmp_path / "page.html"]
    assert run(list(map(str, arguments))) == 0
    out, errors = capsys.readouterr()
    assert "https://" in out and out.endswith("stopped\n") and "Traceback" not in errors
    assert sum("█" in line for line in out.splitlines()) > 10
