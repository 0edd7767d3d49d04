"""One call of an operator, drawn from a seed, and the limits that its answer has to keep."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


@dataclass(frozen=True)
class Bounds:
    """Largest errors of the float32 operator against the float64 reference on the same numbers."""

    values: float = 5e-6
    """Relative L2 of each output."""
    gradients: float = 5e-5
    """Relative L2 of the gradient of each input."""
    peak: float = 1e-4
    """Largest difference of a single element, relative to the largest element of the output."""


ORDINARY = Bounds()
STIFF = Bounds(1e-5, 1e-4)
LONG_NEEDLES = Bounds(2e-5, 2e-4)


@dataclass(frozen=True)
class Case:
    """Arguments of one call. Every float is a float32 number, so that both precisions compute with the same."""

    condition: str
    seed: int
    floats: dict[str, Tensor]
    """Tensor arguments in float64, which are converted to the precision of the call."""
    differentiable: tuple[str, ...]
    """Those of them that get a gradient."""
    others: dict[str, Any] = field(default_factory=dict)
    """Index tensors, sizes, modes."""
    bounds: Bounds = ORDINARY
    floors: dict[str, float] = field(default_factory=dict)
    """Least element size of an output or of the gradient of an input: errors of smaller ones are relative to it."""

    def __post_init__(self):
        for name, tensor in self.floats.items():
            self.floats[name] = tensor.float().double()

    def arguments(self, dtype: torch.dtype, device: torch.device) -> dict[str, Any]:
        """All arguments by keyword, fresh tensors of that precision on that device, which require their gradients."""
        made = {name: tensor.to(device, dtype, copy=True) for name, tensor in self.floats.items()}
        for name in self.differentiable:
            made[name].requires_grad_()
        return made | {k: v.to(device) if isinstance(v, Tensor) else v for k, v in self.others.items()}

    def __str__(self) -> str:
        return f"{self.condition}, seed {self.seed}"


class Sampler:
    """Random numbers of one scene; it neither reads nor changes a global generator."""

    def __init__(self, seed: int):
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """Float64 numbers in [low, high)."""
        return torch.rand(*shape, generator=self.generator, dtype=torch.float64) * (high - low) + low

    def normal(self, *shape: int) -> Tensor:
        """Float64 numbers of mean 0 and variance 1."""
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)

    def units(self, *shape: int) -> Tensor:
        """Random unit vectors along the last axis."""
        vectors = self.normal(*shape)
        return vectors / vectors.norm(dim=-1, keepdim=True)

    def integers(self, end: int, *shape: int) -> Tensor:
        """Whole numbers in [0, end)."""
        return torch.randint(end, shape, generator=self.generator)

    def pick(self, options: Sequence[T]) -> T:
        """One of `options`."""
        return options[int(self.integers(len(options)))]

    def signs(self, *shape: int) -> Tensor:
        """-1 or 1."""
        return 2.0 * self.integers(2, *shape).double() - 1


def sheet(side: int) -> tuple[Tensor, Tensor]:
    """Vertices and faces of a plane of 2 side^2 triangles at z = 0, x and y from 0 to `side`."""
    ticks = torch.arange(side + 1, dtype=torch.float64)
    y, x = torch.meshgrid(ticks, ticks, indexing="ij")
    a = (torch.arange(side)[:, None] * (side + 1) + torch.arange(side)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + side + 2], 1), torch.stack([a, a + side + 2, a + side + 1], 1)])
    return torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3), faces
