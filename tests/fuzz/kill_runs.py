"""Kill commands at random moments: `python tests/fuzz/kill_runs.py render --count 60 --seed 1`.

After each SIGKILL the output must be complete or absent, as far as its final name goes; after one whole run at the end
nothing else may be left beside it. Each run ends at a moment of its own, most of them near the end, where files are
written. Prints a line of JSON.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
from safetensors import safe_open

TOP = Path(__file__).parents[2]
PHOTO = TOP / "src" / "oasis_warp" / "assets" / "photos" / "palm_open_left_02.png"
WHOLE = {
    "render": {"out.png"},
    "edit": {"out.safetensors", "out.png", "out.json"},
    "reconstruct": {"avatar.safetensors", "summary.png", "quality.png", "turntable.mp4", "report.json"},
}


def command(name: str, folder: Path) -> list[str]:
    """The command, whose output goes to `folder`/out."""
    oasis, inputs, out = [sys.executable, "-m", "oasis_warp"], folder.parent, folder / "out"
    if name == "reconstruct":
        return [*oasis, "reconstruct", str(PHOTO), "-o", str(folder), "--size", "64", "--steps", "2"]
    avatar = str(inputs / "made" / "avatar.safetensors")
    if name == "render":
        return [*oasis, "render", avatar, "-o", f"{out}.png", "--size", "128"]
    painted = [str(inputs / "painted.png"), "--photo", str(PHOTO), "--steps", "2", "--size", "64", "--overwrite"]
    return [*oasis, "edit", avatar, *painted, "-o", f"{out}.safetensors"]


def check(folder: Path, whole: set[str]) -> str:
    """"complete" or "absent"; anything else says what is wrong."""
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


def main() -> None:
    """Read the command line, kill the command again and again, and print what was left."""
    parser = argparse.ArgumentParser()
    parser.add_argument("command", choices=sorted(WHOLE))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    counts: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as name:
        top = Path(name)
        folder = top / "work"
        if options.command != "reconstruct":
            subprocess.run(command("reconstruct", top / "made"), check=True, capture_output=True)
            picture = cv2.imread(str(PHOTO))
            height, width = picture.shape[:2]
            cv2.circle(picture, (width // 2, height // 2), width // 20, (0, 0, 255), -1)
            cv2.imwrite(str(top / "painted.png"), picture)
        start = time.monotonic()
        subprocess.run(command(options.command, folder), check=True, capture_output=True)
        seconds = time.monotonic() - start
        for _ in range(options.count):
            for path in folder.glob("[!.]*"):  # each kill meets what the kills before left hidden, and no output
                path.unlink()
            process = subprocess.Popen(
                command(options.command, folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            try:
                process.wait(seconds * (rng.uniform(0, 1.1) if rng.random() < 0.3 else rng.uniform(0.8, 1.1)))
                counts["not killed"] = counts.get("not killed", 0) + 1
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
            left = check(folder, WHOLE[options.command])
            counts[left] = counts.get(left, 0) + 1
        hidden = sum(path.name.startswith(".") for path in (*folder.glob(".*"), *top.glob(".*")))
        done = subprocess.run(command(options.command, folder), capture_output=True)
        after = check(folder, WHOLE[options.command])
        rest = [path.name for path in (*folder.glob(".*"), *top.glob(".*"))]
    report = {"command": options.command, "kills": options.count, "seconds": round(seconds, 1), **counts}
    print(json.dumps({**report, "hidden before": hidden, "exit": done.returncode, "after": after, "hidden": rest}))


if __name__ == "__main__":
    main()
