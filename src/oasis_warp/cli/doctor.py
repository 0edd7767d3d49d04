"""`oasis doctor`: check everything that the package relies on, and say what to do about failures.

Packages are imported inside the checks, so that a broken one fails its own check only.
"""

import importlib.metadata
import math
import os
import platform
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from oasis_warp import __version__
from oasis_warp.cli.developer_options import Doctor
from oasis_warp.cli.progress import FAULT
from oasis_warp.cli.record import note

PACKAGES = {
    "warp-lang": ("1.19", "1.20"),
    "torch": ("2.6", "2.14"),
    "trimesh": ("4", None),
    "libigl": ("2.6", None),
    "scipy": ("1.15", None),
    "opencv-contrib-python-headless": ("5.0.0.93", None),
    "numpy": ("2", None),
    "safetensors": ("0.5", None),
    "threadpoolctl": ("3", None),
    "jaxtyping": ("0.3", None),
    "tyro": ("0.9", None),
    "rich": ("13", None),
}
"""Lowest supported version and upper bound, as in pyproject.toml."""
OTHER_OPENCVS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python")
"""Distributions that install another `cv2` into the same folder."""
HAND_SIZE = (12_337, 24_608)
"""Vertices and faces of the bundled hand."""
TOLERANCE = 5e-6
"""Tolerance of float32 colours: a few roundings of numbers below 1."""


class FaultError(Exception):
    """A failed check: the message says what is wrong, `remedy` what to do."""

    def __init__(self, message: str, remedy: str):
        super().__init__(message)
        self.remedy = remedy


Check = Callable[[], str]
"""Returns a short description; raises `FaultError`, or any error of a broken package."""


def run(options: Doctor) -> int:
    """Print a line for every check; the exit code."""
    console, faults, found = Console(quiet=options.quiet), 0, {}
    to_do = checks(options.build_extension)
    width = max(map(len, to_do))
    for name, check in to_do.items():
        try:
            mark, text = "[green]ok  [/]", check()
        except Exception as error:  # a broken installation may raise anything
            remedy = error.remedy if isinstance(error, FaultError) else "reinstall with `pip install -e .`"
            mark, text = "[red]FAIL[/]", f"{error or type(error).__name__}; {remedy}"
            faults += 1
        found[name] = {"ok": "ok" in mark, "text": text}
        console.print(mark, f"{name:{width}}", text, highlight=False, soft_wrap=True)
    if faults:
        console.print(f"{faults} of {len(to_do)} checks failed.", style="red")
    note(checks=found)
    return FAULT if faults else 0


def checks(build_extension: bool = False) -> dict[str, Check]:
    """All checks by name, in order."""
    packages = {name: lambda name=name: check_package(name) for name in PACKAGES}
    return {
        "oasis_warp": check_python,
        **packages,
        "one OpenCV": check_single_opencv,
        "CPU": check_cpu,
        "CUDA": check_cuda,
        "hand": check_hand,
        "networks": check_networks,
        "prior": check_prior,
        "C++ node": lambda: check_extension(build_extension),
        "kernels": check_kernels,
        "videos": check_videos,
    }


def check_python() -> str:
    """Versions of this program, Python and the system."""
    return f"{__version__}, Python {platform.python_version()}, {platform.platform()}"


def parse_version(text: str) -> tuple[int, ...]:
    """The leading numbers of a version: "2.13.0+cpu" -> (2, 13, 0)."""
    return tuple(int(part) for part in re.findall(r"^\d+|(?<=\.)\d+", text.split("+")[0]))


def check_package(name: str) -> str:
    """The installed version of a package is supported."""
    low, high = PACKAGES[name]
    wanted = f">={low}" + (f",<{high}" if high else "")
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        raise FaultError("not installed", f'run `pip install "{name}{wanted}"`') from None
    number = parse_version(version)
    if number < parse_version(low) or (high and number >= parse_version(high)):
        raise FaultError(f"{version}, expected {wanted}", f'run `pip install "{name}{wanted}"`')
    return version


def check_single_opencv() -> str:
    """There is no second OpenCV."""
    import cv2

    others = []
    for name in OTHER_OPENCVS:
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        others.append(name)
    if others:
        ours = "opencv-contrib-python-headless"
        remedy = f"run `pip uninstall -y {' '.join(others)}`, then `pip install --force-reinstall --no-deps {ours}`"
        raise FaultError(f"{', '.join(others)} is installed too and overwrites cv2", remedy)
    return f"cv2 {cv2.__version__}"


def check_cpu() -> str:
    """Threads and instruction set of torch."""
    import torch

    features = torch.backends.cpu.get_cpu_capability()
    return f"{torch.get_num_threads()} threads on {os.cpu_count()} cores, {features}"


def check_cuda() -> str:
    """CUDA devices, if any."""
    import torch

    if not torch.cuda.is_available():
        return "no device found; everything runs on the CPU"
    devices = [torch.cuda.get_device_properties(i) for i in range(torch.cuda.device_count())]
    return ", ".join(f"{device.name} ({device.total_memory >> 30} GiB)" for device in devices)


def check_hand() -> str:
    """The bundled hand loads and has the expected size."""
    import hashlib

    from oasis_warp.assets import asset
    from oasis_warp.hand.template import bundled_hand

    hand = bundled_hand()
    if (len(hand.template), len(hand.faces)) != HAND_SIZE:
        raise FaultError(f"{len(hand.template)} vertices, {len(hand.faces)} faces", "reinstall oasis-warp")
    digest = hashlib.sha256(asset("hand", "hand_right.npz").read_bytes()).hexdigest()
    return f"{len(hand.template)} vertices, {len(hand.faces)} faces, sha256 {digest[:12]}"


def check_networks() -> str:
    """The landmark networks give the known results."""
    from oasis_warp.estimation.networks import check_networks

    check_networks()
    return "palm detection and hand landmarks give the expected results"


def check_prior() -> str:
    """The learned prior loads, and belongs to the bundled hand."""
    from oasis_warp.core.errors import InputError
    from oasis_warp.network.prior import bundled_prior

    try:
        prior = bundled_prior()
    except InputError as error:
        what, _, remedy = str(error).rpartition("; ")
        raise FaultError(what, remedy.rstrip(".")) from error
    parameters = sum(parameter.numel() for parameter in prior.network.parameters())
    about = dict(prior.about)
    trained = f", {about['step']} steps" if "step" in about else ""
    return f"{prior.network.config.profile}, {parameters / 1e6:.1f} M weights{trained}, sha256 {about['sha256'][:12]}"


def check_kernels() -> str:
    """The rasterizer draws one Gaussian according to its formula, on every device."""
    import torch

    from oasis_warp.ops._runtime.kernel_cache import kernel_cache

    cache = kernel_cache()
    if not _can_write(cache):
        raise FaultError(f"the kernel cache {cache} cannot be written", "set OASIS_WARP_CACHE to a folder of your own")
    seconds = {}
    for device in ["cpu"] + ["cuda"] * torch.cuda.is_available():
        start = time.perf_counter()
        error = gaussian_error(device)
        seconds[device] = time.perf_counter() - start
        if not error <= TOLERANCE:
            raise FaultError(f"{device}: a Gaussian is off by {error:.1e}", f"delete {cache} and run this again")
    times = ", ".join(f"{took:.1f} s on {device}" for device, took in seconds.items())
    return f"a Gaussian is drawn correctly; loaded or compiled in {times}; cache {cache}"


def check_extension(build: bool) -> str:
    """The optional C++ node of `rasterization` on CUDA is built, or is not, which is no fault."""
    from oasis_warp.ops._runtime import picture_extension

    if build:
        try:
            picture_extension.build()
        except picture_extension.NotBuiltError as error:
            remedy = "it needs a C++ compiler, Python's headers and ninja; it is optional and only saves time"
            raise FaultError(f"could not be built: {error}", remedy) from error
    if not picture_extension.is_built():
        return "not built (optional); `oasis doctor --build-extension` builds it"
    return f"built for torch {importlib.metadata.version('torch')}, in {picture_extension.extension_folder()}"


def gaussian_error(device: str) -> float:
    """Largest difference between one drawn Gaussian and opacity * exp(-d^2 / 2 / variance) * colour."""
    import torch

    from oasis_warp.ops import rasterization

    size, focal, depth, scale, opacity = 33, 100.0, 1.0, 0.04, 0.8
    color = torch.tensor([[1.0, 0.5, 0.25]], device=device)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], device=device)
    image, alpha, _ = rasterization(
        means=torch.tensor([[0.0, 0.0, depth]], device=device),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device),
        scales=torch.full((1, 3), scale, device=device),
        opacities=torch.tensor([opacity], device=device),
        colors=color,
        viewmats=torch.eye(4, device=device)[None],
        Ks=K[None],
        width=size,
        height=size,
    )
    # On the optical axis the projection is exact: a round Gaussian, plus the 0.3 px^2 of the pixel's own blur.
    variance = (focal * scale / depth) ** 2 + 0.3
    offset = torch.arange(size, device=device, dtype=torch.float64) - size // 2
    squared = offset[:, None] ** 2 + offset[None, :] ** 2
    expected = opacity * torch.exp(-squared / 2 / variance)
    inside = squared < 4 * variance  # two standard deviations: well inside the cut-off at 1/255
    drawn = torch.cat([image[0], alpha[0]], -1).double()
    formula = torch.cat([expected[..., None] * color.double(), expected[..., None]], -1)
    return float((drawn - formula)[inside].abs().max())


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def check_videos() -> str:
    """Videos of each format can be written and read."""
    import torch

    from oasis_warp.data.pictures import VIDEO_SUFFIXES, write_video

    frames = [torch.full((64, 64, 3), int(127 + 100 * math.sin(i)), dtype=torch.uint8) for i in range(3)]
    with tempfile.TemporaryDirectory() as folder:
        for suffix in VIDEO_SUFFIXES:
            write_video(Path(folder) / f"film{suffix}", frames, 24.0)
    return " and ".join(VIDEO_SUFFIXES)
