"""`oasis view`: an avatar in the browser, served by this machine to itself."""

import hmac
import secrets
import sys
import webbrowser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from oasis_warp.cli.options import View
from oasis_warp.core.errors import InputError
from oasis_warp.export.page_file import page_html
from oasis_warp.hand_avatar import Avatar

LOOPBACK = "127.0.0.1"
HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""Of the page, beside its own content security policy: no other site embeds or reads it."""


class PageServer(ThreadingHTTPServer):
    """Serves one page at `address` on the loopback interface, and nothing else."""

    daemon_threads = True

    def __init__(self, page: str, port: int = 0):
        """Listen on `port`, or on a free one if it is 0.

        Raises:
            OSError: the port is taken, or may not be used.
        """
        super().__init__((LOOPBACK, port), _Handler)
        self.page = page.encode()
        self.token = secrets.token_urlsafe(18)
        self.hosts = {f"{name}:{self.server_port}" for name in (LOOPBACK, "localhost")}

    @property
    def address(self) -> str:
        """What a browser opens."""
        return f"http://{LOOPBACK}:{self.server_port}/{self.token}/"


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    server_version = "oasis"
    sys_version = ""
    timeout = 30

    def do_GET(self) -> None:
        self._answer(with_page=True)

    def do_HEAD(self) -> None:
        self._answer(with_page=False)

    def _answer(self, with_page: bool) -> None:
        # A page of another site may reach this port under a name of its own (DNS rebinding): its Host tells.
        allowed = self.headers.get("Host", "") in self.server.hosts
        if not allowed or not hmac.compare_digest(self.path.encode(), f"/{self.server.token}/".encode()):
            self.send_error(404)
            return
        self.send_response(200)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(self.server.page)))
        self.end_headers()
        if with_page:
            self.wfile.write(self.server.page)

    def log_message(self, format: str, *args: object) -> None:
        """Requests are not logged: their addresses hold the token."""


def run(options: View) -> int:
    """Serve the page until Ctrl-C.

    Raises:
        InputError: a wrong avatar file, or a port that cannot be used.
    """
    if not 0 <= options.port < 2**16:
        raise InputError(f"--port {options.port}: expected 0 to 65535; choose another port, or 0 for a free one.")
    page = page_html(Avatar.load(options.avatar), options.avatar.resolve().parent.name or options.avatar.stem)
    try:
        server = PageServer(page, options.port)
    except OSError as error:
        raise InputError(f"--port {options.port}: cannot be used ({error.strerror}); choose another, or 0.") from error
    with server:
        print(f"The avatar is at {server.address} until Ctrl-C.")
        sys.stdout.flush()
        if not options.no_browser:
            webbrowser.open(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
    return 0
