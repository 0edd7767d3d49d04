"""The prior of hand shapes, measured on photos of real hands.

The bundled model comes from bodies drawn by artists, and its mean hand has a long palm: 99 mm from the wrist to the
middle knuckle at a first phalanx of 45 mm. Photos of real hands are fitted with some 87 mm at 43 mm.
"""

import numpy as np

from oasis_warp.core.hand_model import HandModel

MEANS = {
    "pc0": -0.91, "pc1": 0.11, "pc2": 0.27, "pc3": -0.67, "pc5": -0.10,
    "length_index1": 0.28, "length_index2": -0.30, "length_index3": -0.04,
    "length_middle1": -0.28, "length_middle2": -0.11, "length_middle3": 0.37,
    "length_little1": -0.08, "length_little2": -0.30, "length_little3": -0.12,
    "length_ring2": 0.09, "length_ring3": 0.17, "length_thumb1": 0.41, "length_thumb2": -0.28, "length_thumb3": -0.56,
    "girth_thumb": 0.78, "girth_index": -0.14, "girth_middle": -0.17, "girth_ring": -0.25, "girth_little": -0.08,
    "palm_length": -1.32, "ray_index": -0.52, "ray_middle": -0.32, "ray_ring": -0.82, "ray_little": -1.09,
    "palm_width": 0.80, "palm_thickness": 0.13, "wrist_girth": 0.58,
    "thumb_base_palmar": -0.17, "thumb_base_radial": 0.34,
}  # fmt: skip
"""Mean coefficients of real hands; the others are 0. The mean of fits to the 8 sets and 15 single photos of
tests/data/photos, fitted three times, each with the mean before as its prior. The means of other persons' hands explain
a hand better than the model's mean does, as docs/estimator.md says."""
DEVIATION = 0.5
"""Standard deviation of each. Fits to photos of one hand scattered by as much where the prior had a deviation of 1, and
means of different hands by less."""
ANY = 1.0
"""That of hands whose shape no photos tell: of MANO."""


def shape_prior(hand: HandModel) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations of the shape coefficients of `hand`, [S] each."""
    means = np.array([MEANS.get(name, 0.0) for name in hand.shape_names])
    return means, np.full(len(means), DEVIATION if means.any() else ANY)
