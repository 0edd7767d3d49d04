"""Calls of every public operator with hostile arguments: each gives finite results, or one sentence that says why not.

As a program it makes many calls, in a process of its own so that a crash is seen:
`python tests/ops/hostile_arguments.py CALLS [SEED]`.
"""

import faulthandler
import functools
import random
import subprocess
import sys
import time
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
import torch
from operator_calls import calls
from torch import Tensor

from oasis_warp import ops
from oasis_warp.ops import DECLARATIONS

WHOLE = (0, 1, -1, 3, 2**16, 2**24, 2**31 - 1, 2**31, 2**32, 2**32 + 1, 2**63 - 1, 2**63, 2**64, -(2**63), 10**30)
ODD = (None, True, "x", b"x", 1.5, float("nan"), float("inf"), -float("inf"), 1e300, [], {}, object, 1 + 2j)
VALUES = (float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1e14, -1e14, 1e-45, 0.0, -1.0, 1e-20)
DTYPES = (torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int32, torch.bool, torch.complex64)
INDEX_DTYPES = (*DTYPES, torch.int64, torch.int16, torch.uint8)
INDICES = (-1, -2, 2**31 - 1, -(2**31), 2**31, 2**32, 2**32 + 1, 2**63 - 1, -(2**63), 1000)
MAX_SECONDS = 10.0


class Outcome(NamedTuple):
    """Of a call: "result" or "refusal", else what is wrong with it."""

    kind: str
    detail: str = ""


@functools.cache
def bases() -> list[tuple[str, dict[str, Any]]]:
    """Sound calls: names of operators and their arguments."""
    made = []
    for which in ({}, {"dtype": torch.float64}, {"empty": True}, {"n": 1, "n_poses": 1}):
        found = calls(**which)
        made += [(call.operator, call.arguments) for call in found.values() if call.operator in DECLARATIONS]
        seen, scene = found["depth_visibility"].arguments, found["rasterization"].arguments
        camera = {"viewmat": scene["viewmats"][0], "K": scene["Ks"][0]}
        picture = {name: scene[name] for name in ("means", "quats", "scales", "opacities", "width", "height")}
        made.append(("blend_weights", picture | camera))
        made.append(("blend_colors", {"weights": ops.blend_weights(**made[-1][1]), "colors": scene["colors"].clone()}))
        drawn = ("vertices", "faces", "viewmat", "K", "width", "height")
        made.append(("depth_map", {name: seen[name] for name in drawn}))
        bent = found["face_rotations"].arguments
        made.append(("rest_mesh", {name: bent[name] for name in ("rest_vertices", "faces")}))
    assert {name for name, _ in made} == set(DECLARATIONS)
    return made


def spoilt_tensor(draw: random.Random, tensor: Tensor) -> Any:
    """`tensor` with something wrong, or only unusual, about it."""
    floats = tensor.is_floating_point()

    def with_values(values: tuple[Any, ...]) -> Tensor:
        bad = tensor.clone(memory_format=torch.contiguous_format)
        for _ in range(min(draw.choice((1, 1, 3)), bad.numel())):
            bad.view(-1)[draw.choice((0, -1, draw.randrange(bad.numel())))] = draw.choice(values)
        return bad

    def inference() -> Tensor:
        with torch.inference_mode():
            return tensor.clone()

    axis = draw.randrange(tensor.ndim) if tensor.ndim else 0
    ways = [
        lambda: with_values(VALUES if floats else INDICES),
        lambda: with_values(VALUES if floats else INDICES),
        lambda: torch.full_like(tensor, draw.choice(VALUES) if floats else draw.choice(INDICES)),
        lambda: tensor.to(draw.choice(DTYPES if floats else INDEX_DTYPES)),
        lambda: tensor.to("meta"),
        lambda: tensor[..., None],
        lambda: tensor[None],
        lambda: tensor.narrow(axis, 0, max(tensor.shape[axis] - 1, 0)),
        lambda: tensor.narrow(axis, 0, 0),
        lambda: torch.cat([tensor, tensor], axis),
        lambda: tensor.flatten()[:1].squeeze() if tensor.numel() else tensor.sum(),
        lambda: tensor.mT if tensor.ndim > 1 else tensor,
        lambda: torch.stack([tensor, tensor], -1)[..., 0],
        lambda: tensor.narrow(axis, 0, min(tensor.shape[axis], 1)).expand_as(tensor),
        lambda: tensor.flip(axis),
        lambda: torch._neg_view(tensor) if floats else tensor,
        lambda: tensor.clone().requires_grad_() if floats else tensor,
        lambda: torch.nn.Parameter(tensor) if floats else tensor,
        inference,
        lambda: tensor.to_sparse(),
        lambda: tensor.numpy(),
        lambda: torch.from_numpy(tensor.numpy().copy()),
        lambda: tensor.tolist(),
        lambda: draw.choice(ODD),
    ]
    return draw.choice(ways)()


def spoilt(draw: random.Random, value: Any) -> Any:
    """`value` of an argument with something wrong, or only unusual, about it."""
    if isinstance(value, Tensor):
        return spoilt_tensor(draw, value)
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        whole = list(value)
        whole[draw.randrange(len(whole))] = draw.choice((*WHOLE, *ODD))
        return draw.choice((whole, whole[1:], [], [*whole, 0], np.array(value), draw.choice(ODD)))
    if isinstance(value, bool):
        return draw.choice((not value, 0, 1, None, "x"))
    if value is None or isinstance(value, str):
        return draw.choice(ODD)
    return draw.choice((*WHOLE, *ODD, np.int64(value) if isinstance(value, int) else np.float32(1)))


OPTIONS = {
    "rasterization": {
        "near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3, "tile_size": 16,
        "render_mode": "RGB", "sh_degree": 2, "absgrad": True, "rasterize_mode": "classic", "camera_model": "pinhole",
    },
    "blend_weights": {"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3, "tile_size": 16},
    "depth_map": {"near_plane": 0.01, "outputs": ["depth"]},
    "depth_visibility": {"near_plane": 0.01, "tau": 0.1, "margin": 0.1, "literal": True, "maps": False},
    "pose_on_mesh": {"scale_law": "area"},
}  # fmt: skip
"""Plain arguments that may be spoilt too."""


def hostile_call(seed: int, sound: list[tuple[str, dict[str, Any]]]) -> tuple[str, dict[str, Any], list[str]]:
    """An operator, its arguments, and which of them are spoilt."""
    draw = random.Random(seed)
    name, arguments = draw.choice(sound)
    arguments = dict(arguments)
    for option, value in OPTIONS.get(name, {}).items():
        if draw.random() < 0.1:
            arguments[option] = value
    if draw.random() < 0.3:
        arguments["validate"] = False
    changed = draw.sample(sorted(arguments), min(draw.choice((1, 1, 1, 2, 3)), len(arguments)))
    for key in changed:
        arguments[key] = spoilt(draw, arguments[key])
    if draw.random() < 0.5:
        for key in DECLARATIONS[name].differentiable:
            tensor = arguments.get(key)
            if type(tensor) is Tensor and tensor.is_floating_point() and not tensor.is_inference():
                arguments[key] = tensor.detach().requires_grad_()
    return name, arguments, changed


def is_sentence(error: Exception) -> bool:
    """Whether a message names what it is about, what was expected and what was given, and is short."""
    text = str(error)
    if text.startswith("Inference tensors cannot be saved for backward."):  # torch says what to do
        return True
    return ": expected " in text[:60] and ", got " in text and "\n" not in text and len(text) < 500


def tensors_of(out: Any) -> list[Tensor]:
    if isinstance(out, Tensor):
        return [out.values() if out.layout == torch.sparse_csr else out]
    if isinstance(out, dict):
        out = tuple(out.values())
    return [tensor for part in out for tensor in tensors_of(part)] if isinstance(out, tuple | list) else []


def outcome(name: str, arguments: dict[str, Any]) -> Outcome:
    """What comes of a call and, where it has a gradient, of the gradient."""
    started = time.monotonic()
    try:
        out = tensors_of(getattr(ops, name)(**arguments))
        losses = [part.sum() for part in out if part.requires_grad]
        leaves = [a for a in arguments.values() if isinstance(a, Tensor) and a.requires_grad]
        found = torch.autograd.grad(sum(losses), leaves, allow_unused=True) if losses else ()
    except (ValueError, TypeError, RuntimeError) as error:
        if is_sentence(error):
            return Outcome("refusal")
        return Outcome("raw", f"{type(error).__name__}: {str(error)[:300]}")
    except Exception as error:
        return Outcome("raw", f"{type(error).__name__}: {str(error)[:300]}")
    if time.monotonic() - started > MAX_SECONDS:
        return Outcome("slow", f"{time.monotonic() - started:.0f} s")
    checked = bool(arguments.get("validate", True))
    for place, tensors in (("results", out), ("gradients", found)):
        if checked and any(t is not None and t.isnan().any() for t in tensors):
            return Outcome("NaN", f"in {place}")
    return Outcome("result")


def run(first: int, count: int) -> Counter[str]:
    """Outcomes of calls by kind; what is wrong is printed."""
    sound, counts = bases(), Counter()
    for seed in range(first, first + count):
        print(seed, file=sys.stderr, flush=True)
        name, arguments, changed = hostile_call(seed, sound)
        kind, detail = outcome(name, arguments)
        counts[kind] += 1
        if detail:
            print(f"{seed} {name} {changed}: {kind} {detail}", flush=True)
    return counts


def main(count: int, first: int) -> None:
    """Make the calls in child processes, and say what came of them."""
    if len(sys.argv) > 3:
        faulthandler.enable()
        print(dict(run(first, count)))
        return
    end, crashes = first + count, 0
    while first < end:
        command = [sys.executable, __file__, str(end - first), str(first), "child"]
        child = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=3600)
        if not child.returncode:
            break
        crashes += 1
        seeds = [int(line) for line in child.stderr.splitlines() if line.isdigit()]
        print(f"seed {seeds[-1]} ended the process with {child.returncode}:\n{child.stderr[-2000:]}", flush=True)
        first = seeds[-1] + 1
    print(f"{count} calls, {crashes} crashes")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
