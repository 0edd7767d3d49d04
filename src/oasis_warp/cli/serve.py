"""`oasis serve`: a form in the browser that takes photos and gives avatars, on this machine."""

import json
import threading
from importlib import resources
from urllib.parse import unquote

from oasis_warp.cli.jobs import Jobs
from oasis_warp.cli.loopback import LoopbackHandler, LoopbackServer
from oasis_warp.cli.options import Serve
from oasis_warp.cli.view import serve
from oasis_warp.core.errors import InputError

MAX_BYTES, MAX_DIGITS = 64 << 20, 20
"""Largest photo, and most digits of a Content-Length: Python reads no number of more than 4300 digits."""
FORM = {"": "form.html", "form.css": "form.css", "form.js": "form.js"}
TYPES = {
    ".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8",
    ".png": "image/png", ".mp4": "video/mp4", ".json": "application/json",
}  # fmt: skip
POLICY = "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; media-src 'self'; connect-src 'self'"
"""Content security policy of the form; an avatar's page brings its own."""


class FormServer(LoopbackServer):
    """Serves the form and the results of `jobs`."""

    def __init__(self, jobs: Jobs, port: int = 0):
        super().__init__(port, _Handler)
        self.jobs = jobs


class _Handler(LoopbackHandler):
    server: FormServer

    def do_GET(self) -> None:
        path = self.asked()
        if path is None:
            return
        if path in FORM:
            file = resources.files("oasis_warp.cli") / "serve_form" / FORM[path]
            self._send(file.read_bytes(), FORM[path], Content_Security_Policy=POLICY)
            return
        kind, _, rest = path.partition("/")
        job, _, name = rest.partition("/")
        try:
            if kind == "jobs" and not name and (found := self.server.jobs.look(job)) is not None:
                self._send_json(found._asdict())
            elif kind == "jobs" and name and (file := self.server.jobs.file(job, name)) is not None:
                self._send(file.read_bytes(), name)
            else:
                self.send_error(404)
        except InputError as error:
            self._send_json({"error": str(error)}, 500)

    def do_POST(self) -> None:
        path = self.asked()
        if path is None:
            return
        length = self.headers.get("Content-Length", "")
        if path != "jobs" or not length.isdecimal():
            self.send_error(404 if path != "jobs" else 411)
            return
        if len(length) > MAX_DIGITS or int(length) > MAX_BYTES:
            self.close_connection = True  # the photo is not read
            self._send_json({"error": f"The photo is larger than {MAX_BYTES >> 20} MB; send a smaller one."}, 413)
            return
        photo = self.rfile.read(int(length))
        if len(photo) < int(length):
            return
        try:
            job = self.server.jobs.add(unquote(self.headers.get("X-Name", "")), photo)
        except InputError as error:
            self._send_json({"error": str(error)}, 422)
            return
        self._send_json({"job": job}, 201)

    def _send(self, body: bytes, name: str, **headers: str) -> None:
        suffix = "." + name.rpartition(".")[2]
        if suffix not in TYPES:
            headers["Content_Disposition"] = f'attachment; filename="{name}"'
        self.answer(body, TYPES.get(suffix, "application/octet-stream"), **headers)

    def _send_json(self, value: object, status: int = 200) -> None:
        self.answer(json.dumps(value).encode(), "application/json", status)


def run(options: Serve) -> int:
    """Serve the form and work through the photos until Ctrl-C.

    Raises:
        InputError: the folder cannot be made, or the port cannot be used.
    """
    jobs = Jobs(options.folder)
    with FormServer(jobs, options.port) as server:
        worker = threading.Thread(target=jobs.work)
        worker.start()
        try:
            serve(server, f"The form is at {server.address} until Ctrl-C.", no_browser=options.no_browser)
        finally:
            jobs.stop()
            worker.join()
    return 0
