"""`oasis view`: an avatar, or Gaussians of another program, in the browser, served by this machine to itself."""

import sys
import webbrowser

from oasis_warp.cli.loopback import LoopbackHandler, LoopbackServer
from oasis_warp.cli.options import View
from oasis_warp.data.photo import read_photo
from oasis_warp.data.splat_files import READERS as SPLAT_ENDINGS
from oasis_warp.data.splat_files import read_splats
from oasis_warp.export.page_file import page_html, splats_html
from oasis_warp.hand_avatar import Avatar


class PageServer(LoopbackServer):
    """Serves one page."""

    def __init__(self, page: str, port: int = 0):
        super().__init__(port, _Handler)
        self.page = page.encode()


class _Handler(LoopbackHandler):
    server: PageServer

    def do_GET(self) -> None:
        if (path := self.asked()) == "":
            self.answer(self.server.page, "text/html; charset=utf-8")
        elif path is not None:
            self.send_error(404)

    do_HEAD = do_GET


def run(options: View) -> int:
    """Serve the page until Ctrl-C.

    Raises:
        InputError: a wrong avatar file, file of Gaussians or photo, or a port that cannot be used.
    """
    photo = None if options.photo is None else read_photo(options.photo)
    if options.avatar.suffix.lower() in SPLAT_ENDINGS:
        page = splats_html(read_splats(options.avatar), options.avatar.stem, photo=photo)
    else:
        title = options.avatar.resolve().parent.name or options.avatar.stem
        page = page_html(Avatar.load(options.avatar), title, photo=photo)
    with PageServer(page, options.port) as server:
        serve(server, f"{options.avatar.name} is at {server.address} until Ctrl-C.", no_browser=options.no_browser)
    return 0


def serve(server: LoopbackServer, message: str, *, no_browser: bool) -> None:
    """Say `message`, open the address unless `no_browser`, and serve until Ctrl-C."""
    print(message)
    sys.stdout.flush()
    if not no_browser:
        webbrowser.open(server.address)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        print()
