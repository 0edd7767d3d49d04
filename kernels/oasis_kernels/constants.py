"""Numbers shared by the kernels, the operators and the reference twins: plain floats.

Rasterization follows gsplat 1.5.3; the thresholds are float32 constants in both precisions, so that the float64
build takes the same decisions as the float32 one.
"""

from dataclasses import dataclass

ALPHA_MAX = 0.9990000128746033
"""Largest opacity of a single layer (0.999f). 0.99 in the original 3DGS, where two capped layers land on the stop."""
ALPHA_MIN = 0.003921568859368563
"""Layers fainter than 1/255 (as a float32) are skipped."""
TRANSMITTANCE_STOP = 9.999999747378752e-05
"""The Gaussian that would bring the transmittance to this or below ends the pixel and is not drawn (1e-4f)."""
EXTENT_SIGMAS = 3.33
"""Largest extent of a Gaussian's box in standard deviations; fainter ones end at sqrt(2 ln(255 opacity))."""
JACOBIAN_LIMIT = 0.3
"""x/z and y/z are clamped to the image plus this share of tan(half the field of view), in the Jacobian only."""
EPS2D = 0.3
"""Variance added to both image axes [px^2]: the default low-pass."""
BOX_SLACK = 1e-3
"""Added to a Gaussian's box, relative and in pixels, so that rounding in the blending cannot reach outside it."""
CUT_SLACK = 1e-3
"""Added to the exponent beyond which a layer must be fainter than ALPHA_MIN; the exact test follows."""
CHANNELS = (1, 3, 4, 8, 16, 32, 34)
"""Channel counts that blending kernels are built for; others are padded with zeros up to the next. The last is the
largest number of colours with a depth and a one."""


@dataclass(frozen=True)
class Rules:
    """What a kernel of the rasterizer is built to draw by; the defaults are the rules of gsplat 1.5.3."""

    alpha_min: float = ALPHA_MIN
    transmittance_stop: float = TRANSMITTANCE_STOP
    extent_sigmas: float = EXTENT_SIGMAS
    exp_degree: int = 5
    """Degree of the polynomial of 2^f in the float32 CPU kernels: 3, 4 or 5."""
