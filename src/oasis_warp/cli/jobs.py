"""The queue of `oasis serve`: a folder per photo, one process at a time, kept over restarts."""

import re
import secrets
import subprocess
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import Literal, NamedTuple

from oasis_warp.core.errors import InputError, last_line
from oasis_warp.core.logging import logger
from oasis_warp.data.output_files import write_file

MAX_WAITING = 16
"""Photos in the queue."""
MAX_SECONDS = 900
"""Time for one photo, some fifty times what it takes on two quiet cores."""
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".avif", ".bmp", ".tif", ".tiff")
SILENT = "The program failed without a message."
EXPORTS = (".html", ".glb", ".ply", ".spz")
"""Formats that are written on request."""
PROGRAM = (sys.executable, "-m", "oasis_warp")
"""A process of its own: whatever a photo does to it, the form stays."""
RESULTS = ("summary.png", "quality.png", "turntable.mp4", "avatar.safetensors", "report.json")
ID = re.compile(r"[A-Za-z0-9_-]{22}")

State = Literal["waiting", "running", "done", "failed"]


class Job(NamedTuple):
    """State of one photo in the queue."""

    state: State
    note: str
    """The stage that runs, or the sentence that says why there is no avatar."""
    ahead: int
    """Photos that come first."""


class Jobs:
    """The photos below `folder`: ID/photo.jpg, then ID/out, or ID/error.txt. One is reconstructed at a time."""

    def __init__(self, folder: Path):
        """Take up the photos that an earlier run left waiting, oldest first.

        Raises:
            InputError: the folder cannot be made.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another folder.") from error
        self.folder = folder
        self._changed = threading.Condition()
        self._exporting = threading.Lock()
        left = [path for path in folder.iterdir() if ID.fullmatch(path.name) and self._on_disk(path) is None]
        self._waiting = deque(path.name for path in sorted(left, key=lambda path: path.stat().st_mtime))
        self._failed: dict[str, str] = {}
        """Sentences that could not be written to error.txt; a restart tries these photos again."""
        self._running: tuple[str, str] | None = None
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False

    @staticmethod
    def _on_disk(path: Path) -> Job | None:
        if (path / "out" / "report.json").is_file():
            return Job("done", "", 0)
        if (path / "error.txt").is_file():
            return Job("failed", (path / "error.txt").read_text(encoding="utf-8"), 0)
        return None

    def add(self, name: str, photo: bytes) -> str:
        """Put a photo into the queue; its ID.

        Raises:
            InputError: the queue is full, or the name is none of a picture.
        """
        suffix = Path(name).suffix.lower()
        if suffix not in SUFFIXES:
            raise InputError(f"{name[:80]}: expected a picture, {', '.join(SUFFIXES)}; save the photo as one of these.")
        with self._changed:
            if len(self._waiting) >= MAX_WAITING:
                raise InputError(f"{MAX_WAITING} photos are waiting already; come back in a few minutes.")
            job = secrets.token_urlsafe(16)
            home = self.folder / job
            home.mkdir()
            write_file(home / f"photo{suffix}", photo)
            self._waiting.append(job)
            self._changed.notify()
        return job

    def look(self, job: str) -> Job | None:
        """State of a photo; None if there is no such photo."""
        with self._changed:
            if self._running is not None and self._running[0] == job:
                return Job("running", self._running[1], 0)
            if job in self._waiting:
                return Job("waiting", "", self._waiting.index(job) + (self._running is not None))
            if job in self._failed:
                return Job("failed", self._failed[job], 0)
        return self._on_disk(self.folder / job) if ID.fullmatch(job) else None

    def file(self, job: str, name: str) -> Path | None:
        """A result of a photo that is done, written first if it is an export; None if there is none.

        Raises:
            InputError: it could not be written.
        """
        made = self.look(job)
        if made is None or made.state != "done":
            return None
        out = self.folder / job / "out"
        path = out / name
        if name in RESULTS:
            return path
        if name not in {f"hand{ending}" for ending in EXPORTS}:
            return None
        with self._exporting:
            if not path.is_file():
                command = [*PROGRAM, "export", str(out / "avatar.safetensors"), "-o", str(path)]
                if path.suffix == ".html":
                    command += ["--photo", str(next((self.folder / job).glob("photo.*")))]
                ran = subprocess.run(command, capture_output=True, text=True, timeout=MAX_SECONDS, check=False)
                if ran.returncode:
                    raise InputError(last_line(ran.stderr, SILENT, 500))
        return path

    def work(self) -> None:
        """Reconstruct what waits, until `stop`; whatever goes wrong, each photo ends as done or failed."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopped)
                if self._stopped:
                    return
                job = self._waiting.popleft()
                self._running = job, "starting"
            try:
                why = self._reconstruct(self.folder / job)
            except Exception as error:  # the photos that wait need this thread
                why = f"The program failed: {last_line(str(error), SILENT, 500)}"
            if why is not None and not self._stopped:
                self._fail(job, why)
            with self._changed:
                self._running = self._process = None

    def _fail(self, job: str, why: str) -> None:
        try:
            write_file(self.folder / job / "error.txt", why.encode())
        except InputError as error:
            logger.warning("%s", error)
            self._failed[job] = why

    def stop(self) -> None:
        """End the work; the photo in progress waits again for the next start."""
        with self._changed:
            self._stopped = True
            if self._process is not None:
                self._process.kill()
            self._changed.notify()

    def _reconstruct(self, home: Path) -> str | None:
        """Why there is no avatar of the photo; None where there is one."""
        photo = next(home.glob("photo.*"), None)
        if photo is None:  # the server was stopped before the photo was whole
            return "The photo did not arrive completely; send it again."
        command = [*PROGRAM, "reconstruct", str(photo), "-o", str(home / "out")]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
            with self._changed:
                self._process = process
                if self._stopped:
                    process.kill()
            started, line = time.monotonic(), ""  # before the timer, or what it ends would seem to have been in time
            limit = threading.Timer(MAX_SECONDS, process.kill)
            limit.start()
            assert process.stderr is not None
            for line in process.stderr:
                with self._changed:
                    self._running = home.name, line.partition(":")[0].strip()[:60]
            process.wait()
            limit.cancel()
        if self._on_disk(home) is not None:
            return None
        late = time.monotonic() - started >= MAX_SECONDS
        message = f"It took longer than {MAX_SECONDS // 60} minutes." if late else last_line(line, SILENT, 500)
        return message.replace(str(photo), "the photo").replace(photo.name, "the photo")
