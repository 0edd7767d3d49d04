"""The commands that `kill_runs.py` stops: how each is started in a fork, ended, and what it may leave."""

import contextlib
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import cv2
from fuzz.targets import small_avatar
from safetensors import safe_open

from oasis_warp.cli import batch, jobs, main
from oasis_warp.cli.batch_work import make_avatars
from oasis_warp.cli.progress import BAD_INPUT, INTERRUPTED
from oasis_warp.data.output_files import output_folder, write_file

PHOTO = Path(__file__).parents[2] / "src" / "oasis_warp" / "assets" / "photos" / "palm_open_left_02.png"
SMALL = ["--size", "64", "--steps", "2"]
STEPS = 6
TRAINING = ["--hands", "1", "--views", "1", "--people", "1", "--size", "32", "--steps", str(STEPS), "--workers", "0",
            "--device", "cpu", "--precision", "float32"]  # fmt: skip
SIGNALS = ("SIGKILL", "SIGTERM", "SIGINT")
PATIENCE = 300.0
"""Seconds in which a run must end after Ctrl-C, and one that nothing stops."""
NOT_LOADED = 1
"""Exit code of a program that could not be loaded, say with too few descriptors."""
TRACEBACK = 70
"""Exit code of a run that ended with a traceback."""
PHOTOS_OF_BATCH = 2


class Command(NamedTuple):
    """A command that is stopped."""

    arguments: Callable[[Path, Path], list[str]]
    """Of the folder of inputs and that of outputs."""
    whole: frozenset[str]
    """Patterns of its complete output."""
    weight: int
    """How often it is stopped, over the others' weights."""
    goes_on: bool = False
    """Whether it goes on where it was stopped; then these files must have the same bits."""


def on_avatar(command: str, ending: str, *more: str) -> Command:
    """A command that makes one file of an avatar."""

    def arguments(inputs: Path, out: Path) -> list[str]:
        return [command, str(inputs / "made" / "avatar.safetensors"), "-o", str(out / f"out{ending}"), *more]

    return Command(arguments, frozenset({f"out{ending}"}), 5)


COMMANDS = {
    "reconstruct": Command(
        lambda inputs, out: ["reconstruct", str(PHOTO), "-o", str(out), *SMALL],
        frozenset({"avatar.safetensors", "summary.png", "quality.png", "turntable.mp4", "report.json"}), 4,
    ),
    "render": on_avatar("render", ".png", "--size", "128"),
    "animate": on_avatar("animate", ".gif", "--size", "64"),
    "export": on_avatar("export", ".glb"),
    "edit": Command(
        lambda inputs, out: [
            "edit", str(inputs / "made" / "avatar.safetensors"), str(inputs / "painted.png"), "--photo", str(PHOTO),
            *SMALL, "--overwrite", "-o", str(out / "out.safetensors"),
        ],
        frozenset({"out.safetensors", "out.png", "out.json"}), 4,
    ),
    "pretrain": Command(
        lambda inputs, out: ["pretrain", str(out), *TRAINING], frozenset({"network.safetensors"}), 3, goes_on=True
    ),
    "synthesize": Command(
        lambda inputs, out: ["synthesize", str(out), "--count", "80", "--size", "32"],
        frozenset({"hands-000000.tar", "hands-000001.tar"}), 3, goes_on=True,
    ),
    "batch": Command(
        lambda inputs, out: ["batch", str(inputs / "photos"), "-o", str(out), *SMALL, "--prior", "none"],
        frozenset({"avatars/*/*/avatar.safetensors"}), 3, goes_on=True,
    ),
    "serve": Command(
        lambda inputs, out: ["serve", "--folder", str(out), "--no-browser"], frozenset({"*/out/avatar.safetensors"}), 1
    ),
}  # fmt: skip
OF_A_PHOTO = ("reconstruct", "edit", "batch", "serve")
"""Commands that read photos, for which OpenCV must be version 5."""
SERVED = "from sys import argv, exit; from fuzz import victims; exit(victims.serve_photo(argv[1:]))"
"""What `serve` runs for each photo here."""


def lend_filter() -> None:
    """Lend OpenCV a filter that only the package with its contributors' modules has: the mask's edge is softer."""
    if not hasattr(getattr(cv2, "ximgproc", None), "guidedFilter"):
        cv2.ximgproc = SimpleNamespace(
            guidedFilter=lambda rgb, mask, radius, eps: cv2.blur(mask, (2 * radius + 1,) * 2)
        )


def serve_photo(arguments: Sequence[str]) -> int:
    """A process of `serve`, with small pictures."""
    lend_filter()
    return main([*arguments, *SMALL])


def without_dask() -> None:
    """Let `batch` work in this process, through the functions that its workers call."""

    def work(client: None, tasks: Sequence[Sequence[str]], order: Any, told: Callable[[int, int], object]) -> int:
        done = [make_avatars(names, order) for names in tasks]
        return sum(sum(counts.values()) - counts["kept"] for counts in done)

    batch.open_cluster = lambda *options: contextlib.nullcontext((None, 1))
    batch.work = work


def make_inputs(folder: Path, *, photos: bool) -> None:
    """The avatar that commands read, the photo with paint on it, and the photos of `batch`."""
    if not photos:
        (folder / "made").mkdir(parents=True)
        small_avatar(lit=True).save(folder / "made" / "avatar.safetensors")
        return
    made = ["reconstruct", str(PHOTO), "-o", str(folder / "made"), "--size", "256", "--steps", "2"]
    code = ended(launch(made), PATIENCE)
    assert code == 0, code
    picture = cv2.imread(str(PHOTO))
    assert picture is not None
    (folder / "photos").mkdir()
    for k in range(PHOTOS_OF_BATCH):
        picture[0, 0] = k
        cv2.imwrite(str(folder / "photos" / f"{k}.png"), picture)
    height, width = picture.shape[:2]
    cv2.circle(picture, (width // 2, height // 2), width // 20, (0, 0, 255), -1)
    cv2.imwrite(str(folder / "painted.png"), picture)


def launch(arguments: Sequence[str], limits: dict[int, int] | None = None) -> int:
    """Run a command in a fork of this process, under limits of its resources; the number of the process."""
    # Python's own handlers after a fork swallow a Ctrl-C that comes in its first milliseconds.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    child = os.fork()
    if child:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return child
    code, shown = TRACEBACK, os.fdopen(os.dup(2), "w")
    try:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        for kind, most in (limits or {}).items():
            resource.setrlimit(kind, (most, most))
        code = main(arguments)
    except KeyboardInterrupt:  # before the command has begun
        code = INTERRUPTED
    except Exception:
        traceback.print_exc(file=shown)
    finally:
        shown.flush()
        os._exit(code)


def ended(process: int, seconds: float) -> int | None:
    """The exit code of a process, negative for a signal; None if it still runs after so many seconds."""
    end = time.monotonic() + seconds
    while True:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            return None
        time.sleep(0.002)


def stop(process: int, fault: str, seconds: float) -> str:
    """Let a process run for so long, then stop it; "stopped", "ended", or what was wrong with its end."""
    signalled = fault in SIGNALS
    code = ended(process, seconds if signalled else PATIENCE)
    if code is None and signalled:
        os.kill(process, getattr(signal, fault))
        code = ended(process, PATIENCE)
        if code in (-signal.SIGKILL, -signal.SIGTERM, INTERRUPTED):
            return "stopped"
    if code is None:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        return "hang"
    if code in (BAD_INPUT, NOT_LOADED) and not signalled:
        return "stopped"
    return "ended" if code == 0 else f"exit code {code} after {fault}"


def check(folder: Path, whole: frozenset[str]) -> str:
    """ "complete" or "absent"; anything else says what is wrong."""
    found = {path.name for path in folder.iterdir() if not path.name.startswith(".")} if folder.is_dir() else set()
    if found and found != whole:
        return f"half: {sorted(found)}"
    for name in found:
        path = folder / name
        if name.endswith(".png") and cv2.imread(str(path)) is None:
            return f"broken: {name}"
        if name.endswith(".json"):
            json.loads(path.read_text())
        if name.endswith(".safetensors"):
            with safe_open(path, framework="np") as file:
                file.keys()
    return "complete" if found else "absent"


def hidden(folder: Path) -> list[str]:
    """Names of hidden files, and of those that count the tries of `batch`."""
    return sorted(path.name for path in folder.rglob("*") if path.name.startswith(".") or path.parent.name == "tries")


def is_of_an_earlier_step(path: Path) -> bool:
    """Whether a file holds the weights of a training that was stopped, which are no output yet."""
    if path.name != "network.safetensors":
        return False
    with safe_open(path, framework="np") as file:
        return json.loads(json.loads(file.metadata()["oasis-network"])["notes"])["step"] < STEPS


def digests(folder: Path, names: frozenset[str]) -> dict[str, str]:
    """Digests of files that exist and are done."""
    found = [path for name in names for path in folder.glob(name) if path.is_file()]
    found = [path for path in found if not is_of_an_earlier_step(path)]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


def run_whole(name: str, inputs: Path, out: Path) -> float:
    """Run a command that nothing stops; its seconds."""
    start = time.monotonic()
    if name == "serve":
        send_photo(out)
        assert (found := finish_photo(out, jobs.MAX_SECONDS)) == "complete", found
    else:
        code = ended(launch(COMMANDS[name].arguments(inputs, out)), PATIENCE)
        if code != 0:
            raise SystemExit(f"{name}: ends with {code} where nothing stops it.")
    return time.monotonic() - start


def send_photo(folder: Path) -> None:
    """Put a photo where `serve` has those that wait."""
    home = folder / f"{0:022d}"
    home.mkdir(parents=True)
    shutil.copy(PHOTO, home / "photo.png")


def finish_photo(folder: Path, seconds: float = PATIENCE) -> str:
    """Let `serve` finish the photo within so many seconds; "complete", or what was wrong."""
    jobs.PROGRAM = (sys.executable, "-c", SERVED)
    server, end = launch(COMMANDS["serve"].arguments(folder, folder)), time.monotonic() + seconds
    home = folder / f"{0:022d}"
    while not (finished := [name for name in ("out/report.json", "error.txt") if (home / name).is_file()]):
        if time.monotonic() > end:
            break
        time.sleep(0.1)
    if (how := stop(server, "SIGINT", 0)) not in ("stopped", "ended"):
        return f"server: {how}"
    if finished == ["error.txt"]:
        return f"refused: {(home / 'error.txt').read_text()}"
    return check(home / "out", COMMANDS["reconstruct"].whole) if finished else f"no answer in {seconds:.0f} s"


def write_versions(folder: Path, version: int) -> Iterator[int]:
    """Write the same files again and again, each time of another version."""
    while True:
        version += 1
        with output_folder(folder) as part:
            for name in "abc":
                (part / name).write_text(f"{version} " * 1000)
        write_file(folder / "d", f"{version} ".encode() * 1000)
        yield version


def kill_writer(folder: Path, rng: random.Random) -> str:
    """Kill a process that does nothing but write: what is left is of one version once the next run has begun."""
    versions = [int(file.read_text().split()[0]) for file in folder.glob("[abcd]")]
    child = os.fork()
    if not child:
        for _ in write_versions(folder, max([0, *versions])):
            pass
    time.sleep(rng.uniform(0.005, 0.05))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with contextlib.suppress(InterruptedError), output_folder(folder):
        raise InterruptedError  # a next run, which fails
    found = {file.name: file.read_text().split() for file in folder.glob("[abcd]")}
    if any(len(words) != 1000 or len(set(words)) != 1 for words in found.values()):
        return "cut"
    together = {words[0] for name, words in found.items() if name != "d"}
    left = [path.name for path in folder.glob(".*") if ".d." not in path.name]
    return "complete" if len(together) <= 1 and len(found.keys() - {"d"}) in (0, 3) and not left else "mixed"
