"""Stop commands at random moments: `python3 tests/fuzz/kill_runs.py --jobs 12 --seconds 300 --out kills.jsonl`.

Each run is a fork of this process, so that none of it is imports. It ends at a moment of its own, spread over its whole
length, by SIGKILL, SIGTERM or Ctrl-C; or no file may grow beyond a random size, as on a full disk, or few files may be
open, or little memory is left, or a second process writes the same output and the first one is killed. After that the
output of most commands must be complete or absent as far as its final name goes, and after one whole run at the end
nothing else may be left beside it. `pretrain`, `synthesize` and `batch` are started again until they end, and must
leave the same bits as a run that nothing stopped; photos given to `serve` must all become avatars. "files" is a process
that does nothing but write.

Fault k of a seed is always the same. Each adds a line of JSON to --out, and those that stand there are not done again:
the same command goes on. In the end a line of JSON counts them all; the exit code is 1 if one was not survived. It
needs no more than the commands do: `batch` runs without Dask, in one process; `kill_batch.py` does the rest of it.
"""

import argparse
import collections
import importlib
import json
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TOP = Path(__file__).parents[2]
PATHS = [str(TOP / "src"), str(TOP / "kernels"), str(TOP / "tests")]
sys.path[:0] = PATHS
os.environ["PYTHONPATH"] = os.pathsep.join([*PATHS, os.environ.get("PYTHONPATH", "")])  # of the processes of `serve`
os.environ["OMP_NUM_THREADS"] = "1"

import cv2  # noqa: E402 - the paths come first
import torch  # noqa: E402
from fuzz import victims  # noqa: E402
from fuzz.victims import COMMANDS, OF_A_PHOTO, SIGNALS  # noqa: E402

FAULTS = {"SIGKILL": 12, "SIGTERM": 3, "SIGINT": 3, "full disk": 2, "few files": 2, "little memory": 1, "two": 1}
"""What ends runs, with weights: half are SIGKILL."""
FEW_FILES, LITTLE_MEMORY = 24, 1 << 30
"""Files that may be opened more than those that are, at most, and bytes of address space."""
FILES = "files"
MARGIN = 1.3
"""Seconds kept for what is still to be done, over those that it took before."""
SLOWER = 10
"""How much longer than before `serve` may take for the photo, as the load of the machine changes."""
N_FILES = 20
"""Kills of the writer for one fault: each takes 30 ms."""


class Whole:
    """What a command does when nothing stops it."""

    def __init__(self, name: str, inputs: Path) -> None:
        out = inputs / f"whole_{name}"
        victims.run_whole(name, inputs, out)  # builds kernels
        shutil.rmtree(out)
        self.seconds = victims.run_whole(name, inputs, out)
        self.digests = victims.digests(out, COMMANDS[name].whole)
        assert len(self.digests) >= len(COMMANDS[name].whole) or not COMMANDS[name].goes_on, os.listdir(out)
        self.largest = max(path.stat().st_size for path in out.rglob("*") if path.is_file())


def choose_fault(seed: int, number: int, names: list[str]) -> tuple[str, str, random.Random]:
    """The command and the fault of a number, and what its moment is drawn from."""
    rng = random.Random(f"{seed} {number}")
    (name,) = rng.choices(names, [1 if name == FILES else COMMANDS[name].weight for name in names])
    (fault,) = rng.choices(list(FAULTS), list(FAULTS.values()))
    if name == FILES:
        fault = "SIGKILL"
    if name == "serve" and fault not in SIGNALS:
        fault = "SIGTERM"
    return name, fault, rng


def limits_of(fault: str, whole: Whole, rng: random.Random) -> dict[int, int]:
    """Limits of resources that a run meets at random moments."""
    if fault == "full disk":
        return {resource.RLIMIT_FSIZE: rng.randrange(whole.largest)}
    if fault == "few files":
        return {resource.RLIMIT_NOFILE: len(os.listdir("/proc/self/fd")) + rng.randrange(FEW_FILES)}
    if fault == "little memory":
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        return {resource.RLIMIT_AS: pages * os.sysconf("SC_PAGE_SIZE") + rng.randrange(LITTLE_MEMORY)}
    return {}


def stop_once(name: str, fault: str, whole: Whole, inputs: Path, out: Path, rng: random.Random) -> dict[str, Any]:
    """Start a command, stop it and look at what it left."""
    command, moment = COMMANDS[name], round(rng.uniform(0, whole.seconds), 3)
    if not command.goes_on or victims.digests(out, command.whole) == whole.digests:
        for path in out.glob("[!.]*"):  # each run meets what those before left hidden, and no output
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    if name == "serve":
        victims.send_photo(out)
    arguments = command.arguments(inputs, out)
    second = victims.launch(arguments) if fault == "two" else None
    process = victims.launch(arguments, limits_of(fault, whole, rng))
    how = victims.stop(process, "SIGKILL" if second else fault, moment)
    wrong = "" if how in ("stopped", "ended") else how
    if second is not None and (code := victims.ended(second, victims.PATIENCE)) != 0:
        wrong = f"exit code {code} beside another process"
    if name == "serve":
        how = "stopped" if how == "ended" else how  # it never ends by itself
        found = victims.finish_photo(out, max(victims.PATIENCE, SLOWER * whole.seconds))
        wrong = wrong or ("" if found == "complete" else found)
    elif command.goes_on:
        now = victims.digests(out, command.whole)
        found = "goes on" if now.items() < whole.digests.items() else "other bits"
        found = "same bits" if now == whole.digests else found
        if found == "other bits" or (found == "goes on" and how == "ended"):
            wrong = wrong or found
    else:
        found = victims.check(out, command.whole)
        wrong = wrong or ("" if found in ("complete", "absent") else found)
    return {"after": moment if fault in SIGNALS else None, "end": how, "output": found, "wrong": wrong}


def stop_number(
    number: int, choice: tuple[str, str, random.Random], wholes: dict[str, Whole], inputs: Path, home: Path
) -> dict[str, Any]:
    """Do one fault; its line."""
    name, fault, rng = choice
    out = home / name
    out.mkdir(parents=True, exist_ok=True)
    if name == FILES:
        found = {victims.kill_writer(out, rng) for _ in range(N_FILES)}
        line = {"end": "stopped", "output": "complete", "wrong": " ".join(sorted(found - {"complete"}))}
    else:
        line = stop_once(name, fault, wholes[name], inputs, out, rng)
    return {"number": number, "command": name, "fault": fault, **line}


def finish(name: str, whole: Whole, inputs: Path, home: Path) -> dict[str, Any]:
    """A whole run where others were stopped: what is there after it."""
    out = home / name
    if name == "serve":
        shutil.rmtree(out)
    before = len(victims.hidden(out))
    victims.run_whole(name, inputs, out)
    if COMMANDS[name].goes_on:
        same = victims.digests(out, COMMANDS[name].whole) == whole.digests
    else:
        same = name == "serve" or victims.check(out, COMMANDS[name].whole) == "complete"
    left = victims.hidden(out)
    wrong = "" if same and not left else f"left {left}" if left else "other output"
    return {"command": name, "hidden before": before, "wrong": wrong}


def work(
    options: argparse.Namespace, names: list[str], wholes: dict[str, Whole], inputs: Path, job: int, queue: Any
) -> None:
    """Do the faults that the queue names until it is empty or the time is over, then the whole runs."""
    home, touched = inputs / f"job_{job}", set[str]()

    def write(line: dict[str, Any]) -> None:
        with options.out.open("a") as file:  # a short line is written at once
            file.write(json.dumps({"seed": options.seed, **line}) + "\n")

    while (number := queue.get()) is not None:
        choice = choose_fault(options.seed, number, names)
        ahead = [choice[0], *touched | {choice[0]}]  # this one, and the whole runs
        if time.monotonic() + MARGIN * sum(wholes[name].seconds for name in ahead if name != FILES) > options.end:
            break
        write(stop_number(number, choice, wholes, inputs, home))
        touched.add(choice[0])
    for name in sorted(touched - {FILES}):
        write(finish(name, wholes[name], inputs, home))


def read_lines(options: argparse.Namespace) -> list[dict[str, Any]]:
    """What stands in --out of this seed; a line that was cut off does not count."""
    lines = []
    for text in options.out.read_text().splitlines() if options.out.is_file() else ():
        try:
            lines.append(json.loads(text))
        except ValueError:
            continue
    return [line for line in lines if line["seed"] == options.seed]


def count(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """All lines in numbers, and those that were not survived."""
    stopped = [line for line in lines if "fault" in line and line["end"] != "ended"]
    of_command = collections.Counter(f"{line['command']}, {line['fault']}" for line in stopped)
    outputs = collections.Counter(line["output"] for line in lines if "fault" in line)
    wrong = [line for line in lines if line["wrong"]]
    faults = {
        "faults": len(stopped), "SIGKILL": sum(line["fault"] == "SIGKILL" for line in stopped),
        "ended before": sum("fault" in line for line in lines) - len(stopped),
        "whole runs after": sum("hidden before" in line for line in lines),
    }  # fmt: skip
    return {**faults, "outputs": outputs, "by command": dict(sorted(of_command.items())), "wrong": wrong}


def main() -> int:
    """Read the command line, stop the commands again and again, and print what was left; the exit code."""
    known = [FILES, *sorted(COMMANDS)]
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", choices=[*known, []], help="All of them by default.")
    parser.add_argument("--count", type=int, default=700, help="Runs in all: some end before their fault.")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="Of the whole run, at most.")
    parser.add_argument("--jobs", type=int, default=1, help="Faults at the same time.")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("kills.jsonl"))
    options = parser.parse_args()
    options.end = time.monotonic() + options.seconds
    options.out.parent.mkdir(parents=True, exist_ok=True)
    photos = int(cv2.__version__.split(".")[0]) >= 5
    names = [name for name in options.commands or known if photos or name not in OF_A_PHOTO]
    torch.set_num_threads(1)  # forks of a process with threads may wait for ever
    cv2.setNumThreads(0)
    victims.lend_filter()
    victims.without_dask()
    done = {line["number"] for line in read_lines(options) if "fault" in line}
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder)
        victims.make_inputs(inputs, photos=photos)
        for name in names:
            if name != FILES:
                importlib.import_module(f"oasis_warp.cli.{name}")
        with context.Pool(options.jobs) as pool:
            commands = [name for name in names if name != FILES]
            wholes = dict(zip(commands, pool.starmap(Whole, [(name, inputs) for name in commands], 1), strict=True))
        queue = context.Queue()
        for number in range(options.count):
            if number not in done:
                queue.put(number)
        for _ in range(options.jobs):
            queue.put(None)
        arguments = [(options, names, wholes, inputs, job, queue) for job in range(options.jobs)]
        processes = [context.Process(target=work, args=each) for each in arguments]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        queue.cancel_join_thread()
    found = count(read_lines(options))
    found["seconds"] = {name: round(whole.seconds, 1) for name, whole in wholes.items()}
    found["jobs that failed"] = sum(process.exitcode != 0 for process in processes)
    found["not done, as OpenCV is older"] = [] if photos else list(OF_A_PHOTO)
    print(json.dumps(found))
    return int(bool(found["wrong"] or found["jobs that failed"]))


if __name__ == "__main__":
    sys.exit(main())
