"""Arguments that must be refused, by name: values that are no numbers, wrong shapes, indices out of range."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from oasis_warp.certify.case import Case
from oasis_warp.certify.compare import Measurement
from oasis_warp.certify.families import Family

POISON = (math.nan, math.inf, -math.inf)


def refusals(family: Family, case: Case, device: torch.device) -> list[Measurement]:
    """How many of the bad calls are not refused by a ValueError that begins with the argument's name."""
    return [
        Measurement(family.name, f"{kind} not refused by name", f"{case}: {name} {what}", float(not refused), 0.0)
        for kind, name, what, refused in attempts(family, case, device)
    ]


def attempts(family: Family, case: Case, device: torch.device) -> Iterator[tuple[str, str, str, bool]]:
    """(kind of fault, argument, what it was, whether it was refused) for every bad call."""
    good = case.arguments(torch.float32, device)
    for name in case.floats:
        for value in POISON:
            bad = good[name].detach().clone()
            bad.view(-1)[bad.numel() // 2] = value
            yield "NaN or Inf", name, f"with {value}", is_refused(family, good, name, bad)
        bad = good[name].detach()[..., :-1] if good[name].dim() > 1 else good[name].detach()[:-1]
        yield "wrong shapes", name, f"of shape {list(bad.shape)}", is_refused(family, good, name, bad)
    for name, (rows, least) in family.indices.items():
        named = case.floats[rows]
        for value in (least - 1, named.shape[-2] if named.dim() > 1 else len(named)) if name in good else ():
            bad = good[name].clone()
            bad.view(-1)[bad.numel() // 2] = value
            yield "wrong indices", name, f"with {value}", is_refused(family, good, name, bad)


def is_refused(family: Family, good: dict[str, Any], name: str, bad: Tensor) -> bool:
    """Whether the call with `bad` in the place of one argument ends as it should.

    Of two shapes that do not go together either argument may be named.
    """
    blamed = {name} if bad.shape == good[name].shape else set(good)
    try:
        family.call(good | {name: bad})
    except ValueError as error:
        return str(error).split(":")[0] in blamed
    except Exception:  # whatever else a bad argument breaks is what this looks for
        return False
    return False
