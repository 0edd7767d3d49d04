"""An HTTP server that only this machine reaches, at an address that only its user knows."""

import hmac
import secrets
import socket
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from oasis_warp.core.errors import InputError

LOOPBACK = "127.0.0.1"
HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""No other site embeds or reads what is served."""


class LoopbackServer(ThreadingHTTPServer):
    """Serves at `address` on the loopback interface, below a token."""

    daemon_threads = True

    def __init__(self, port: int, handler: type["LoopbackHandler"]):
        """Listen on `port`, or on a free one if it is 0.

        Raises:
            InputError: the port does not exist, is taken, or may not be used.
        """
        if not 0 <= port < 2**16:
            raise InputError(f"--port {port}: expected 0 to 65535; choose another port, or 0 for a free one.")
        try:
            super().__init__((LOOPBACK, port), handler)
        except OSError as error:
            raise InputError(f"--port {port}: cannot be used ({error.strerror}); choose another, or 0.") from error
        self.token = secrets.token_urlsafe(18)
        self.hosts = {f"{name}:{self.server_port}" for name in (LOOPBACK, "localhost")}

    def handle_error(self, request: object, client_address: object) -> None:
        """Print the traceback of an error that is ours, not of a browser that went away."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]

    @property
    def address(self) -> str:
        """What a browser opens."""
        return f"http://{LOOPBACK}:{self.server_port}/{self.token}/"


class LoopbackHandler(BaseHTTPRequestHandler):
    """Answers what is asked for below the token, and nothing else."""

    server: LoopbackServer
    server_version = "oasis"
    sys_version = ""
    timeout = 30
    connection: socket.socket

    def asked(self) -> str | None:
        """The path after the token; None for strangers, who have been answered."""
        # A page of another site may reach this port under a name of its own (DNS rebinding): its Host tells. A form of
        # another site tells its Origin.
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin")
        token, _, rest = self.path.removeprefix("/").partition("/")
        known = hmac.compare_digest(token.encode(), self.server.token.encode()) and self.path[1 + len(token) :] != ""
        if host in self.server.hosts and origin in (None, f"http://{host}") and known:
            return rest
        self.send_error(404)
        return None

    def answer(self, body: bytes, content_type: str, status: int = 200, **headers: str) -> None:
        """Send `body`; only its headers to a HEAD. An underscore in a header's name is a hyphen."""
        self.send_response(status)
        extra = {name.replace("_", "-"): value for name, value in headers.items()}
        for name, value in {**HEADERS, "Content-Type": content_type, **extra}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not logged: their addresses hold the token."""
