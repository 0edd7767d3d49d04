"""Float32 rasterization on the CPU, strip by strip: `strip_lists.cpp`, `strips.cpp` and `strip_weights.cpp`.

`strips.cpp` describes the layout. What is drawn decides how a kernel is built: the number of channels, the rules of
blending, and for the adjoint which gradients are wanted.
"""

import functools
import math
from typing import NamedTuple

from oasis_kernels.constants import ALPHA_MAX, Rules
from oasis_kernels.runtime.native import PHASE_WORDS, Native, native

COLUMNS = 8
"""Columns of a vector: it has two rows of them."""
RECORD = 16
"""Words of a record."""
PAD = 8
"""Columns of a strip's planes past its last."""
RECORD_CHANNELS = 3
"""Colours that fit in a record; more are read from their tensor."""
MAX_SHUFFLED = 4
"""Channels that are shuffled between planes and pixels; more are copied one by one."""
CHUNK = 2048
"""Gaussians of a task, at least."""
MAX_CHUNKS = 64
"""Tasks that Gaussians are shared out to, at most: their counts are a table of tasks times strips."""
STATE = 2 * PHASE_WORDS
"""Words of zeros that the threads of a kernel share; `fill_weights` takes PHASE_WORDS."""

EXP2 = {
    3: (0.9999280705, 0.6932609868, 0.242611174, 0.05517168985),
    4: (0.9999992614, 0.6931218145, 0.2402474485, 0.0559178621, 0.009570101652),
    5: (1.000000072, 0.6931469671, 0.2402211972, 0.05550713276, 0.00967554154, 0.001327647174),
}
"""Coefficients of 2^f on |f| <= 0.5, constant term first: relative minimax."""


def literal(value: float) -> str:
    """`value` as a C++ float that reads back to the same number."""
    text = repr(value)
    return f"{text}f" if "." in text or "e" in text else f"{text}.f"


def _constants(rules: Rules, channels: int = 0) -> dict[str, object]:
    """Macros of all kernels: the layout, the rules, and how a layer is cut off."""
    table = 12582912.0, math.log2(rules.alpha_min), ALPHA_MAX, rules.transmittance_stop, *EXP2[rules.exp_degree]
    polynomial = f"(V)(k[{4 + rules.exp_degree}])"
    for k in reversed(range(rules.exp_degree)):
        polynomial = f"fma(f, {polynomial}, (V)(k[{4 + k}]))"
    # Rules may let the box cut off what is not yet too faint; else the exponent alone decides.
    inside = "& (X >= (float)box[0]) & (X < (float)box[2]) & (Y >= (float)box[1]) & (Y < (float)box[3])"
    cuts = rules.extent_sigmas**2 < -2 * math.log(rules.alpha_min)
    return {
        "LANES": 2 * COLUMNS, "COLUMNS": COLUMNS, "PAD": PAD, "AHEAD": 8,
        "TABLE": ", ".join(literal(c) for c in table), "POLYNOMIAL": polynomial,
        "INSIDE": inside.replace("box", "((const int*)r + 12)") if cuts else "",
        "CHANNELS": channels, "FEW_CHANNELS": int(0 < channels <= MAX_SHUFFLED),
    }  # fmt: skip


@functools.cache
def collect(channels: int) -> Native:
    """Kernel: projected Gaussians -> records, and how long each strip's list will be. `channels` in a record, or 0."""
    constants = _constants(Rules()) | {"IN_RECORD": channels}
    return native("rasterize/strip_lists.cpp", "collect", label=f"collect_{channels}", constants=constants)


@functools.cache
def draw(channels: int, rules: Rules) -> Native:
    """Kernel: records and counts -> image over the backgrounds, alpha, and what the adjoint needs."""
    few = channels <= MAX_SHUFFLED
    sums = [f"fma((V)color[{k}], weight, load(t + {k + 1} * stride))" for k in range(channels)]
    # A few sums are read before anything is stored: what is read after a store waits for it in part.
    constants = _constants(rules, channels) | {
        "PLANES": channels + 1, "BATCH": 64,
        "COLOR": "r + 9" if channels <= RECORD_CHANNELS else "colors + (long long)list[place] * CHANNELS",
        "READ": "".join(f"const V sum{k} = {value};" for k, value in enumerate(sums)) if few else "",
        "ADD": "".join(f"store(t + {k + 1} * stride, {f'sum{k}' if few else v});" for k, v in enumerate(sums)),
    }  # fmt: skip
    return native("rasterize/strips.cpp", "draw", label=f"draw_{channels}", constants=constants)


class Gradients(NamedTuple):
    """The gradients that an adjoint is built for."""

    channels: int
    """Channels of the incoming gradient by the image; 0 where there is only one by alpha."""
    shape: bool
    """By means2d, covars2d and opacities."""
    color: bool


def pair_words(gradients: Gradients) -> int:
    """Floats of a pair's record: whole quarters of a vector."""
    return -(-(6 * gradients.shape + gradients.channels * gradients.color) // 4) * 4


@functools.cache
def draw_backward(gradients: Gradients, rules: Rules) -> Native:
    """Kernel: gradients by image and alpha -> by means2d, covars2d, opacities, colours, and the strips' backgrounds."""
    channels = range(gradients.channels)
    step = "-behind"
    for k in channels:
        step = f"fma(g{k}, (V)color[{k}], {step})"
    values = [f"m{k}" for k in range(6 * gradients.shape)] + [f"c{k}" for k in channels if gradients.color]
    padded = values + ["(V)(0.f)"] * (-len(values) % 4)
    in_record = gradients.channels <= RECORD_CHANNELS
    constants = _constants(rules, gradients.channels) | {
        "PLANES": gradients.channels + 2, "SHAPE": int(gradients.shape), "RECORD": len(padded),
        "SUMMED": gradients.channels * gradients.color, "VALUES": len(values),
        "COLOR": "r + 9" if in_record else "colors + index * CHANNELS",
        "ACCUMULATORS": " ".join(f"V c{k} = {{}};" for k in channels),
        # All is read before anything is stored: for the compiler, a store could change what is read after it.
        "READ_GRADIENTS": " ".join(f"const V g{k} = load(t + {k + 2} * stride);" for k in channels),
        "STEP": step,
        "ADD_COLORS": " ".join(f"c{k} = fma(weight, g{k}, c{k});" for k in channels if gradients.color),
        "REDUCE": " ".join(f"reduce({', '.join(padded[k : k + 4])}, out + {k});" for k in range(0, len(padded), 4)),
    }  # fmt: skip
    label = f"draw_backward_{gradients.channels}_{gradients.shape:d}{gradients.color:d}"
    return native("rasterize/strips_backward.cpp", "draw_backward", label=label, constants=constants)


@functools.cache
def count_weights(rules: Rules) -> Native:
    """Kernel: records and counts -> sorted lists, and the number of weights of every pair and of every pixel."""
    return native("rasterize/strip_weights.cpp", "count_weights", constants=_constants(rules))


@functools.cache
def fill_weights(rules: Rules) -> Native:
    """Kernel: sorted lists and where weights belong -> both matrices' indices and values."""
    return native("rasterize/strip_weights.cpp", "fill_weights", constants=_constants(rules))
