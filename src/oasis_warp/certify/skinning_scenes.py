"""Points and covariances that follow bones."""

from collections.abc import Callable

import torch
from torch import Tensor

from oasis_warp.certify.case import STIFF, Bounds, Case, Draw
from oasis_warp.core.rotation import to_matrix

COUNTS = (0, 1, 7, 60, 300)
JOINTS = (1, 4, 16)

Condition = Callable[[Draw, dict[str, Tensor]], Bounds]
CONDITIONS: dict[str, Condition] = {}


def condition(name: str) -> Callable[[Condition], Condition]:
    """Enter a function, which changes the float arguments of `skin`, into `CONDITIONS`."""

    def enter(function: Condition) -> Condition:
        CONDITIONS[name] = function
        return function

    return enter


@condition("ordinary")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    return Bounds()


@condition("one bone each")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    n, n_joints = floats["weights"].shape
    floats["weights"] = torch.eye(n_joints, dtype=torch.float64)[draw.integers(n_joints, n)]
    return STIFF


@condition("affine bones")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    shear = torch.eye(3, dtype=torch.float64) + 0.2 * draw.normal(len(floats["transforms"]), 3, 3)
    floats["transforms"][:, :3, :3] = floats["transforms"][:, :3, :3] @ shear
    return STIFF


@condition("mirroring bones")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    # Three unlike stretches: of a plain mirror image no rotation is the nearest.
    floats["transforms"][:, :3, :3] *= torch.tensor([-0.4, 1.0, 1.7])
    return STIFF


@condition("flat covariances")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    if "covars" in floats:
        row = draw.normal(len(floats["means"]), 3)
        floats["covars"] = row[:, :, None] * row[:, None]
    return STIFF


@condition("any unit of length")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    unit = draw.pick((1e-9, 1e-3, 1e3, 1e6))
    floats["means"] *= unit
    floats["transforms"][:, :3, 3] *= unit
    if "covars" in floats:
        floats["covars"] *= unit**2
    return STIFF


@condition("far from the origin")
def _(draw: Draw, floats: dict[str, Tensor]) -> Bounds:
    floats["transforms"][:, :3, 3] += torch.tensor([1000.0, -500.0, 2000.0])
    return STIFF


def skin_case(
    name: str,
    seed: int,
    n: int | None = None,
    n_joints: int | None = None,
    rotation_only: bool | None = None,
    with_covars: bool | None = None,
) -> Case:
    """Points under the condition `name`."""
    draw = Draw(seed)
    n, n_joints = draw.pick(COUNTS) if n is None else n, draw.pick(JOINTS) if n_joints is None else n_joints
    with_covars = draw.pick((True, True, False)) if with_covars is None else with_covars
    transforms = torch.eye(4, dtype=torch.float64).repeat(n_joints, 1, 1)
    # Bones within about a right angle of each other, as in a hand: their blends stay far from singular.
    turn = draw.normal(4)
    transforms[:, :3, :3] = to_matrix(turn / turn.norm() + 0.3 * draw.normal(n_joints, 4))
    transforms[:, :3, 3] = draw.normal(n_joints, 3)
    half = draw.normal(n, 3, 3)
    floats = {
        "means": draw.normal(n, 3),
        "covars": half @ half.mT,
        "weights": (2 * draw.normal(n, n_joints)).softmax(-1),
        "transforms": transforms[:, : draw.pick((3, 4))],
    }
    if not with_covars:
        del floats["covars"]
    bounds = CONDITIONS[name](draw, floats)
    turn = draw.pick((False, True)) if rotation_only is None else rotation_only
    others = {"rotation_only": turn and with_covars} | ({} if with_covars else {"covars": None})
    return Case(name, seed, floats, tuple(floats), others, bounds)
