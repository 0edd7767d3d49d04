"""One call of an operator, drawn from a seed, and the limits its answer has to keep."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


@dataclass(frozen=True)
class Bounds:
    """Largest errors of the float32 operator against the float64 twin on the same numbers."""

    values: float = 5e-6
    """Relative L2 of each output."""
    gradients: float = 5e-5
    """Relative L2 of each input's gradient."""
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
    wanted: tuple[str, ...]
    """Those of them that get a gradient."""
    others: dict[str, Any] = field(default_factory=dict)
    """Index tensors, sizes, modes."""
    bounds: Bounds = ORDINARY
    floors: dict[str, float] = field(default_factory=dict)
    """Size of the elements of an output or of an input's gradient that counts as little: errors of smaller ones are
    relative to this number."""

    def __post_init__(self):
        for name, tensor in self.floats.items():
            self.floats[name] = tensor.float().double()

    def arguments(self, dtype: torch.dtype, device: torch.device) -> dict[str, Any]:
        """Everything as keywords, fresh tensors of that precision on that device; those wanted require a gradient."""
        made = {name: tensor.to(device, dtype, copy=True) for name, tensor in self.floats.items()}
        for name in self.wanted:
            made[name].requires_grad_()
        return made | {k: v.to(device) if isinstance(v, Tensor) else v for k, v in self.others.items()}

    def __str__(self) -> str:
        return f"{self.condition}, seed {self.seed}"


class Draw:
    """Random numbers of one scene; nothing outside it is read or changed."""

    def __init__(self, seed: int):
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """Float64 numbers in [low, high)."""
        return torch.rand(*shape, generator=self.generator, dtype=torch.float64) * (high - low) + low

    def normal(self, *shape: int) -> Tensor:
        """Float64 numbers of mean 0 and variance 1."""
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)

    def integers(self, end: int, *shape: int) -> Tensor:
        """Whole numbers in [0, end)."""
        return torch.randint(end, shape, generator=self.generator)

    def pick(self, options: Sequence[T]) -> T:
        """One of `options`."""
        return options[int(self.integers(len(options)))]

    def signs(self, *shape: int) -> Tensor:
        """-1 or 1."""
        return 2.0 * self.integers(2, *shape).double() - 1
