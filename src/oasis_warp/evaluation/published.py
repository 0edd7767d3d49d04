"""Numbers that papers print, to stand beside our own: constants with their source, and nothing that we measured.

All are those of OASIS (MM '26), which took over the rows of other methods from their papers or ran them; OHTA is Zheng
et al. (CVPR 2024). SSIM and LPIPS depend on how they are computed, see docs/evaluation.md: compare with care.
"""

from typing import NamedTuple


class Published(NamedTuple):
    """A row of a paper's table."""

    name: str
    psnr: float
    """[dB]"""
    ssim: float
    lpips: float
    """100 times LPIPS."""


RESULTS = {
    "interhand": (
        Published("SelfRecon", 26.38, 0.879, 14.21),
        Published("HumanNeRF", 27.64, 0.884, 11.45),
        Published("HandAvatar", 28.23, 0.894, 10.35),
        Published("HARP", 19.82, 0.761, 22.49),
        Published("Handy", 25.56, 0.794, 14.98),
        Published("HandAvatar, one photo", 23.79, 0.820, 17.78),
        Published("OHTA", 26.11, 0.864, 12.93),
        Published("LHM, no fine-tuning", 24.45, 0.901, 13.96),
        Published("OASIS, no fine-tuning", 26.48, 0.950, 11.74),
        Published("OASIS", 27.38, 0.956, 11.45),
    ),
    "hanco": (
        Published("HandAvatar", 24.68, 0.896, 8.25),
        Published("OHTA", 25.24, 0.923, 7.18),
        Published("OASIS", 25.86, 0.974, 6.76),
    ),
}
"""By data set: OASIS, table 1 and the table of HanCo in its appendix."""
MODEL_ABLATION = {
    "a": Published("full model", 27.38, 0.956, 11.45),
    "b": Published("w/o VETs", 26.97, 0.955, 12.11),
    "b.1": Published("w/o aggregation", 27.08, 0.955, 11.87),
    "b.2": Published("w/o LTEP", 27.12, 0.955, 11.98),
    "c": Published("w/o VPIA", 27.10, 0.955, 12.09),
    "c.1": Published("w/o bias", 27.07, 0.955, 12.08),
    "d": Published("w/o FoM", 27.13, 0.955, 12.35),
}
"""OASIS, table 2, on InterHand2.6M."""
ONE_SHOT_ABLATION = {
    "a": Published("full model", 27.38, 0.956, 11.45),
    "b": Published("w/o texture prior", 25.88, 0.912, 16.24),
    "c": Published("w/o colour calibration", 26.59, 0.951, 11.98),
    "d": Published("w/o texture learning", 27.02, 0.953, 12.18),
    "e": Published("w/o regularisation", 27.08, 0.954, 12.28),
    "f": Published("w/o LoRA: full tuning", 27.11, 0.954, 12.06),
}
"""OASIS, the ablation of one-shot reconstruction in its appendix, on InterHand2.6M."""
SPEED = {"OASIS": (390.0, 5.0), "OHTA": (0.16, 60.0), "HandAvatar": (0.16, None)}
"""Frames a second on an A100, and minutes for a person ("approximately 5", "around 1 hour"): OASIS, section 4.2."""
