"""Make `assets/estimator/gestures.npz`: the prior of joint angles by which a photo is fitted.

    python asset_build/build_gestures.py

Mean and covariance of the bends of each gesture of the synthetic world (`synthetic.contact.GESTURES`), and how often
it occurs, over random gestures without self-collisions.
"""

from pathlib import Path

import numpy as np

from oasis_warp.hand.kinematics import bundled_kinematics
from oasis_warp.hand.template import bundled_hand
from oasis_warp.synthetic.contact import GESTURE_NAMES, sample_gesture, separate

COUNT, BATCH, SEED = 12_000, 1_000, 5
"""Random gestures, how many are separated at once, and the seed."""


def main() -> None:
    """Sample gestures, write their statistics."""
    hand, rng = bundled_hand(), np.random.default_rng(SEED)
    joint, axis = bundled_kinematics().dofs.T
    names, drawn = zip(*(sample_gesture(rng, hand) for _ in range(COUNT)), strict=True)
    at_rest = np.tile(1e3 * hand.joints.double().numpy(), (BATCH, 1, 1))
    apart = [separate(np.stack(drawn[k : k + BATCH]), at_rest)[0] for k in range(0, COUNT, BATCH)]
    angles = np.concatenate(apart)
    angles[:, :, 0] += hand.rest_bend.double().numpy()
    bends = angles[:, joint, axis]
    own = [bends[np.array(names) == name] for name in GESTURE_NAMES]
    target = Path(__file__).parents[1] / "src/oasis_warp/assets/estimator/gestures.npz"
    np.savez_compressed(
        target,
        means=np.stack([b.mean(0) for b in own]).astype(np.float32),
        covariances=np.stack([np.cov(b.T) for b in own]).astype(np.float32),
        shares=np.array([len(b) / COUNT for b in own], np.float32),
    )
    print(target.name, target.stat().st_size)


if __name__ == "__main__":
    main()
