"""Stop commands at random moments: `python tests/fuzz/kill_runs.py edit export --count 60 --seed 1`.

Each run is a fork of this process, so that none of it is imports, and ends at a moment of its own, spread over its
whole length: by SIGKILL, by SIGTERM or Ctrl-C, or because no file may grow beyond a random size, as on a full disk.
After that the output of most commands must be complete or absent as far as its final name goes, and after one whole run
at the end nothing else may be left beside it. `pretrain` and `synthesize` are started again until they end, and must
leave the same bits as a run that nothing stopped; photos given to `serve` must all become avatars. Prints a line of
JSON a command.
"""

import argparse
import collections
import contextlib
import hashlib
import importlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import torch
from safetensors import safe_open

from oasis_warp.cli import jobs, main
from oasis_warp.cli.console import BAD_INPUT, INTERRUPTED
from oasis_warp.data.output_files import output_folder

PHOTO = Path(__file__).parents[2] / "src" / "oasis_warp" / "assets" / "photos" / "palm_open_left_02.png"
SMALL = ["--size", "64", "--steps", "2"]
TRAINING = ["--hands", "1", "--views", "1", "--people", "1", "--size", "32", "--steps", "6", "--workers", "0",
            "--device", "cpu", "--precision", "float32"]  # fmt: skip
FAULTS = {"SIGKILL": 5, "SIGTERM": 2, "SIGINT": 2, "full disk": 1}
"""What ends runs, with weights."""
PATIENCE = 300.0
"""Seconds in which a run must end after Ctrl-C, and one that nothing stops."""
TRACEBACK = 70
"""Exit code of a run that ended with a traceback."""


class Command(NamedTuple):
    """A command that is stopped."""

    arguments: Callable[[Path, Path], list[str]]
    """Of the folder of inputs and that of outputs."""
    whole: frozenset[str]
    """Names of its complete output."""
    goes_on: bool = False
    """Whether it goes on where it was stopped; then these files must have the same bits."""


def on_avatar(command: str, ending: str, *more: str) -> Command:
    """A command that makes one file of an avatar."""

    def arguments(inputs: Path, out: Path) -> list[str]:
        return [command, str(inputs / "made" / "avatar.safetensors"), "-o", str(out / f"out{ending}"), *more]

    return Command(arguments, frozenset({f"out{ending}"}))


COMMANDS = {
    "reconstruct": Command(
        lambda inputs, out: ["reconstruct", str(PHOTO), "-o", str(out), *SMALL],
        frozenset({"avatar.safetensors", "summary.png", "quality.png", "turntable.mp4", "report.json"}),
    ),
    "render": on_avatar("render", ".png", "--size", "128"),
    "animate": on_avatar("animate", ".gif", "--size", "64"),
    "export": on_avatar("export", ".glb"),
    "edit": Command(
        lambda inputs, out: [
            "edit", str(inputs / "made" / "avatar.safetensors"), str(inputs / "painted.png"), "--photo", str(PHOTO),
            *SMALL, "--overwrite", "-o", str(out / "out.safetensors"),
        ],
        frozenset({"out.safetensors", "out.png", "out.json"}),
    ),
    "pretrain": Command(
        lambda inputs, out: ["pretrain", str(out), *TRAINING], frozenset({"network.safetensors"}), goes_on=True
    ),
    "synthesize": Command(
        lambda inputs, out: ["synthesize", str(out), "--count", "80", "--size", "32"],
        frozenset({"synthetic-000000.tar", "synthetic-000001.tar"}), goes_on=True,
    ),
}  # fmt: skip
SERVED = f"from sys import argv, exit; from oasis_warp.cli import main; exit(main([*argv[1:], *{SMALL}]))"
"""What `serve` runs for each photo here."""


def launch(arguments: Sequence[str], n_bytes: int | None = None) -> int:
    """Run a command in a fork of this process, in which files may have `n_bytes`; the number of the process."""
    child = os.fork()
    if child:
        return child
    code, shown = TRACEBACK, os.fdopen(os.dup(2), "w")
    try:
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        if n_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, n_bytes))
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
    code = ended(process, PATIENCE if fault == "full disk" else seconds)
    if code is None and fault != "full disk":
        os.kill(process, getattr(signal, fault))
        code = ended(process, PATIENCE)
        if code in (-signal.SIGKILL, -signal.SIGTERM, INTERRUPTED):
            return "stopped"
    if code is None:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        return "hang"
    if code == BAD_INPUT and fault == "full disk":
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


def hidden(*folders: Path) -> list[str]:
    """Names of hidden files."""
    return sorted(path.name for folder in folders if folder.is_dir() for path in folder.glob(".*"))


def digests(folder: Path, names: frozenset[str]) -> dict[str, str]:
    """Digests of files that exist."""
    return {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names if (folder / name).is_file()
    }


def run_whole(command: Command, inputs: Path, out: Path) -> float:
    """Run a command that nothing stops; its seconds."""
    start = time.monotonic()
    code = ended(launch(command.arguments(inputs, out)), PATIENCE)
    if code != 0:
        raise SystemExit(f"{command.arguments(inputs, out)}: ends with {code} where nothing stops it.")
    return time.monotonic() - start


def stop_runs(command: Command, count: int, inputs: Path, rng: random.Random) -> dict[str, object]:
    """Stop a command `count` times; what was found."""
    out, counts = inputs / "work", collections.Counter()
    run_whole(command, inputs, out)  # builds kernels
    shutil.rmtree(out)
    seconds = run_whole(command, inputs, out)
    expected = digests(out, command.whole)
    largest = max(path.stat().st_size for path in out.iterdir() if path.is_file())
    while count > 0:
        if not command.goes_on or expected == digests(out, command.whole):
            for path in out.glob("[!.]*"):  # each run meets what those before left hidden, and no output
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        (fault,) = rng.choices(list(FAULTS), list(FAULTS.values()))
        n_bytes = rng.randrange(largest) if fault == "full disk" else None
        how = stop(launch(command.arguments(inputs, out), n_bytes), fault, rng.uniform(0, seconds))
        counts[fault if how == "stopped" else how] += 1
        count -= how != "ended"
        if not command.goes_on:
            counts[check(out, command.whole)] += 1
        elif how == "ended":
            counts["same bits" if digests(out, command.whole) == expected else "other bits"] += 1
    before = len(hidden(out, inputs))
    run_whole(command, inputs, out)
    same = digests(out, command.whole) == expected if command.goes_on else check(out, command.whole) == "complete"
    return {
        "seconds": round(seconds, 1),
        **counts,
        "hidden before": before,
        "whole": same,
        "hidden": hidden(out, inputs),
    }


def stop_servers(count: int, inputs: Path, rng: random.Random) -> dict[str, object]:
    """Stop `oasis serve` at random moments of its work on a photo, and look whether the next one finishes it."""
    jobs.PROGRAM = (sys.executable, "-c", SERVED)
    counts: collections.Counter[str] = collections.Counter()
    for k in range(count):
        folder = inputs / f"served_{k}"
        home = folder / f"{k:022d}"
        home.mkdir(parents=True)
        shutil.copy(PHOTO, home / "photo.png")
        arguments = ["serve", "--folder", str(folder), "--no-browser"]
        (fault,) = rng.choices(list(FAULTS)[:3], list(FAULTS.values())[:3])
        counts[f"{fault}, {stop(launch(arguments), fault, rng.uniform(0, 15))}"] += 1
        server, end = launch(arguments), time.monotonic() + PATIENCE
        while time.monotonic() < end and not (home / "out" / "report.json").is_file():
            time.sleep(0.1)
        done = (home / "out" / "report.json").is_file() and check(home / "out", COMMANDS["reconstruct"].whole)
        counts[f"avatar {done}"] += 1
        stop(server, "SIGINT", 0)
    return dict(counts)


WRITER = """
import sys
from pathlib import Path
from oasis_warp.data.output_files import output_folder, write_file
folder, version = Path(sys.argv[1]), int(sys.argv[2])
print("ready", flush=True)
while True:
    version += 1
    with output_folder(folder) as part:
        for name in "abc":
            (part / name).write_text(f"{version} " * 1000)
    write_file(folder / "d", f"{version} ".encode() * 1000)
"""
"""Writes the same files again and again, each time of another version."""


def kill_writers(count: int, rng: random.Random) -> dict[str, int]:
    """Kill a process that does nothing but write: what is left is of one version once the next run has begun."""
    counts, version = {"one version": 0, "mixed": 0, "cut": 0, "left": 0}, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "out"
        for _ in range(count):
            command = [sys.executable, "-c", WRITER, str(folder), str(version)]
            process = subprocess.Popen(command, stdout=subprocess.PIPE)
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(rng.uniform(0, 0.05))
            process.kill()
            process.wait()
            process.stdout.close()
            with contextlib.suppress(InterruptedError), output_folder(folder):
                raise InterruptedError  # a next run, which fails
            found = [file.read_text().split() for file in sorted(folder.glob("[abc]"))]
            whole = [file.read_text().split() for file in sorted(folder.glob("[abcd]"))]
            counts["cut"] += any(len(words) != 1000 or len(set(words)) != 1 for words in whole)
            counts["one version" if len({words[0] for words in found}) <= 1 and len(found) in (0, 3) else "mixed"] += 1
            version = max([version, *(int(words[0]) for words in whole)])
            counts["left"] += sum(path.name.startswith(".") and ".d." not in path.name for path in folder.glob(".*"))
    return counts


def make_inputs(folder: Path) -> None:
    """The avatar that commands read, and the photo with paint on it."""
    code = ended(
        launch(["reconstruct", str(PHOTO), "-o", str(folder / "made"), "--size", "256", "--steps", "2"]), 300.0
    )
    assert code == 0, code
    picture = cv2.imread(str(PHOTO))
    assert picture is not None
    height, width = picture.shape[:2]
    cv2.circle(picture, (width // 2, height // 2), width // 20, (0, 0, 255), -1)
    cv2.imwrite(str(folder / "painted.png"), picture)


def run_all() -> None:
    """Read the command line, stop the commands again and again, and print what was left."""
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="+", choices=["files", "serve", *sorted(COMMANDS)])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(1)  # forks of a process with threads may wait for ever
    cv2.setNumThreads(0)
    with tempfile.TemporaryDirectory() as name:
        if set(options.commands) - {"files", "serve", "pretrain", "synthesize"}:
            make_inputs(Path(name))
        for command in options.commands:
            if command != "files":
                importlib.import_module(f"oasis_warp.cli.{command}")
            rng = random.Random(options.seed)
            if command == "files":
                found = kill_writers(options.count, rng)
            elif command == "serve":
                found = stop_servers(options.count, Path(name), rng)
            else:
                found = stop_runs(COMMANDS[command], options.count, Path(name), rng)
                shutil.rmtree(Path(name) / "work")
            print(json.dumps({"command": command, "faults": options.count, **found}), flush=True)


if __name__ == "__main__":
    run_all()
