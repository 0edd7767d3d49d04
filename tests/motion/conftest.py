import pytest
from fuzz.targets import small_avatar

from oasis_warp.hand_avatar import Avatar


@pytest.fixture(scope="session")
def avatars():
    """The same hand as a left and as a right one."""
    left = small_avatar(lit=False)
    right = Avatar(
        side="right", shape=left.shape, surface_offsets=left.surface_offsets, gaussians=left.gaussians,
        source_pose=left.source_pose, source_camera=left.source_camera,
    )  # fmt: skip
    return {"left": left, "right": right}


@pytest.fixture(params=["left", "right"])
def avatar(request, avatars):
    return avatars[request.param]
