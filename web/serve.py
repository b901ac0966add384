r"""The built page on this machine, to its own browser only unless told otherwise.

    python -m web serve                                        http://127.0.0.1:8000, for this machine
    adb reverse tcp:8000 tcp:8000                              ... and for a Quest on a cable, under the same address
    python -m web serve --host 0.0.0.0 --cert C --key K        https, for a headset in the same network

WebXR needs HTTPS or the loopback address.  The server hands out the files of one folder and reads nothing else.
"""

from __future__ import annotations

import errno
import ssl
from dataclasses import dataclass
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from plumbing.cli import UserError, arg, cli

FOLDER = Path(__file__).resolve().parent / "dist"
PORT = (lambda v: 0 <= v <= 65535, "from 0 to 65535")
# The same policy stands in index.html, for hosts that send no headers of their own.
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'; connect-src 'self'; "
    "style-src 'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'"
)


@dataclass
class Options:
    """What `python -m web serve` can be told."""

    host: str = arg("127.0.0.1", "address to listen on; 0.0.0.0 is every network that this machine is in")
    port: int = arg(8000, "port, 0 = a free one", check=PORT)
    cert: str | None = arg(None, "certificate for https (PEM)")
    key: str | None = arg(None, "its private key (PEM), where the certificate's file does not hold it")
    folder: str = arg(str(FOLDER), "folder to serve")


class Handler(SimpleHTTPRequestHandler):
    """Files of the folder, with the page's security policy."""

    protocol_version = "HTTP/1.1"
    extensions_map = SimpleHTTPRequestHandler.extensions_map | {
        ".wasm": "application/wasm",
        ".js": "text/javascript",
        ".json": "application/json",
        ".csv": "text/csv",
        ".bin": "application/octet-stream",
    }

    def end_headers(self):
        self.send_header("Content-Security-Policy", f"{POLICY}; frame-ancestors 'none'")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def list_directory(self, path):
        """No lists of what there is."""
        self.send_error(404)

    def log_message(self, *_):
        """Nothing is printed or kept about who looked."""


def make_server(opt: Options) -> ThreadingHTTPServer:
    """A server that is bound, but does not run yet.

    Raises    UserError: nothing is built, an address that cannot be had, or a certificate that cannot be read
    Test      tests/web/test_web.py::test_loopback_only, test_bad_arguments
    """
    folder = Path(opt.folder)
    if not (folder / "index.html").is_file():
        raise UserError(f"{folder}: no index.html; build the page first: cd web && npm ci && npm run build")
    if opt.key and not opt.cert:
        raise UserError("--key is given without --cert: give both, or neither")
    context = None
    if opt.cert:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            context.load_cert_chain(opt.cert, opt.key)
        except (OSError, ssl.SSLError) as error:
            raise UserError(f"--cert {opt.cert}: {error.strerror or error}; valid: a certificate and its key") from None
    try:
        server = ThreadingHTTPServer((opt.host, opt.port), partial(Handler, directory=str(folder)))
    except OSError as error:
        taken = "; another program has it: give another --port" if error.errno == errno.EADDRINUSE else ""
        raise UserError(f"cannot listen on {opt.host}:{opt.port}: {error.strerror or error}{taken}") from None
    if context:
        # The handshake is left to each connection's own thread: a silent visitor must not hold up the others.
        server.socket = context.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
    return server


def main(argv=None):
    """Serve until interrupted.  Test: tests/web/test_web.py::test_bad_arguments"""
    opt = cli(Options, argv, "web serve", __doc__)
    server = make_server(opt)
    print(f"{'https' if opt.cert else 'http'}://{opt.host}:{server.server_address[1]}/  (Ctrl-C ends)", flush=True)
    if not opt.cert and opt.host not in ("127.0.0.1", "localhost"):
        print("note: WebXR needs https or the loopback address: give --cert, or use adb reverse", flush=True)
    with server:
        server.serve_forever()
