"""A prior of joint angles: hands make gestures, in which fingers bend together.

A photo often hides joints: the ends of bent fingers, or fingers behind others. A normal distribution about a relaxed
hand, each angle by itself, leaves these half straight. In a mixture of gestures, what is seen of a hand tells the rest.
"""

import functools
from typing import NamedTuple

import numpy as np

from oasis_warp.assets import asset
from oasis_warp.hand.kinematics import HandKinematics


class GesturePrior(NamedTuple):
    """A mixture of G normal distributions of the A free angles of a hand, in the order of `HandKinematics.dofs`."""

    means: np.ndarray
    """[rad], [G, A]."""
    roots: np.ndarray
    """Triangular R of the inverse covariances R^T R, [G, A, A]."""
    costs: np.ndarray
    """Logarithms of the determinant of the covariance less twice that of the weight, 0 for the least, [G]."""

    def scores(self, angles: np.ndarray) -> np.ndarray:
        """Cost of the angles [rad], [A], in each gesture: minus twice the logarithm of its density, [G]."""
        off = np.einsum("gab,gb->ga", self.roots, angles - self.means)
        return (off**2).sum(1) + self.costs

    def term(self, angles: np.ndarray, gesture: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Residuals [A + 1] and Jacobian [A + 1, A] of the likeliest gesture (max-mixture, Olson and Agarwal 2013).

        The last residual is the root of that gesture's own cost, so that gestures can be compared.

        Args:
            angles: [rad], [A].
            gesture: Take this one instead.
        """
        k = int(self.scores(angles).argmin()) if gesture is None else gesture
        residual = np.append(self.roots[k] @ (angles - self.means[k]), np.sqrt(self.costs[k]))
        return residual, np.vstack([self.roots[k], np.zeros(len(angles))])


def gesture_prior(kinematics: HandKinematics, widths: tuple[float, float, float]) -> GesturePrior:
    """The gestures of the synthetic world, widened, because real hands are not drawn from them.

    `widths` are standard deviations of flexion, abduction and twist [rad].
    """
    joint, axis = kinematics.dofs.T
    bend = np.where(axis == 0, kinematics.rest_bend[joint], 0.0)
    return _gesture_prior(bend.tobytes(), axis.tobytes(), widths)


@functools.lru_cache(8)
def _gesture_prior(rest_bend: bytes, axis: bytes, widths: tuple[float, float, float]) -> GesturePrior:
    """Built by `asset_build/build_gestures.py` from bends, which are angles plus those at rest."""
    with asset("estimator", "gestures.npz").open("rb") as file, np.load(file, allow_pickle=False) as stored:
        means, covariances, shares = (stored[name].astype(float) for name in ("means", "covariances", "shares"))
    covariances = covariances + np.diag(np.square(widths)[np.frombuffer(axis, int)])
    roots = np.linalg.cholesky(np.linalg.inv(covariances)).transpose(0, 2, 1)
    costs = np.linalg.slogdet(covariances)[1] - 2 * np.log(shares)
    return GesturePrior(means - np.frombuffer(rest_bend), np.ascontiguousarray(roots), costs - costs.min())
