"""Serving of a page on the local network by https, which browsers of headsets need for VR."""

from __future__ import annotations

import datetime
import ipaddress
import os
import socket
import socketserver
import ssl
import sys
import tempfile
from contextlib import suppress
from http.server import SimpleHTTPRequestHandler
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

from pansplat.export.page import PageFiles
from pansplat.system.console import can_print

PORT = 8443  # or any free one
_DAYS = 30  # for which a certificate is valid
_TIMEOUT = 60.0  # seconds without a byte after which a connection is closed
_TYPES = {".html": "text/html; charset=utf-8", ".bin": "application/octet-stream", ".jpg": "image/jpeg"}
_ELSEWHERE = ("192.0.2.1", 9)  # an address of documentation (RFC 5737), to which nothing is sent


class PageServer(socketserver.ThreadingMixIn, socketserver.TCPServer):
    """Serves the files of one page, and nothing else, until `serve_forever` is interrupted.

    The certificate is made anew, for the machine's address, and signed by itself: browsers warn of it once.

    Attributes:
        url: address of the page in the local network.
    """

    allow_reuse_address = os.name == "posix"  # elsewhere it would share the port
    daemon_threads = True

    def __init__(self, page: PageFiles) -> None:
        folder = page.files[0].parent
        self.files = {b"/" + os.fsencode(file.relative_to(folder).as_posix()): str(file) for file in page.files}
        self.files[b"/"] = str(page.files[0])
        address = find_address()
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        with tempfile.TemporaryDirectory() as temporary:
            file = Path(temporary) / "certificate.pem"
            file.write_bytes(make_certificate(address))
            context.load_cert_chain(file)
        try:
            super().__init__(("", PORT), _Handler)
        except OSError:  # the port is in use
            super().__init__(("", 0), _Handler)
        # Each connection shakes hands in its own thread.
        self.socket = context.wrap_socket(self.socket, server_side=True, do_handshake_on_connect=False)
        self.url = f"https://{address}:{self.server_address[1]}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore connections that clients close or that do not speak https."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


class _Handler(SimpleHTTPRequestHandler):
    """Answers GET and HEAD."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "pansplat", ""
    extensions_map = _TYPES
    timeout = _TIMEOUT
    server: PageServer

    def translate_path(self, path: str) -> str:
        """The file of the page at an address; elsewhere none, which is answered by "not found"."""
        return self.server.files.get(unquote_to_bytes(path.partition("?")[0]), "")

    def end_headers(self) -> None:
        """Of every answer: no other page may frame it, its type is the stated one, and it is not kept."""
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", "frame-ancestors 'none'")
        self.send_header("X-Content-Type-Options", "nosniff")
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing."""


def find_address() -> str:
    """The IPv4 address of this machine in its network; 127.0.0.1 without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_ELSEWHERE)  # chooses the interface
        except OSError:
            return "127.0.0.1"
        return probe.getsockname()[0]


def make_certificate(address: str) -> bytes:
    """A self-signed certificate for an IPv4 address and this machine, and its private key, as PEM."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "pansplat export --serve")])
    hosts = [x509.IPAddress(ipaddress.ip_address(host)) for host in dict.fromkeys((address, "127.0.0.1"))]
    now = datetime.datetime.now(datetime.timezone.utc)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))  # clocks of headsets may be late
        .not_valid_after(now + datetime.timedelta(days=_DAYS))
        .add_extension(x509.SubjectAlternativeName([*hosts, x509.DNSName("localhost")]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return certificate.public_bytes(serialization.Encoding.PEM) + secret


def serve_page(page: PageFiles) -> None:
    """Print a page's address with a QR code, and serve the page until Ctrl+C or SIGTERM."""
    import segno

    with PageServer(page) as server, suppress(KeyboardInterrupt):
        if can_print("█▀▄"):
            segno.make(server.url, micro=False).terminal(sys.stdout, border=2, compact=True)
        print(
            f"{server.url} shows it to every device in this network until Ctrl+C; a browser warns once, because the "
            "certificate is self-made: choose to go on",
            flush=True,
        )
        server.serve_forever()
    print("stopped")
