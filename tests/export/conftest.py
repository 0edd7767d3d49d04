import pytest
import torch
from synthetic import as_left_hand, avatar_of, crop_of

from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.core import surface
from oasis_warp.core.types import HandLight
from oasis_warp.export import texture
from oasis_warp.export.page_file import page_html


@pytest.fixture(scope="session")
def right_hand(hand):
    """A hand whose regions differ in colour, in a light from the left, its palm to the camera."""
    crop, truth, pose = crop_of(hand, region_colors(label_regions(hand), 0.03), size=64)
    harmonics = torch.tensor([[0.9, 0.9, 0.8], [-0.3, -0.3, -0.3], [-0.2, -0.2, -0.1], [-0.1, -0.1, 0]])
    light = HandLight(harmonics, torch.tensor([[0.2] * 3, [1.6] * 3]), torch.full((3,), 0.9))
    return avatar_of(hand, truth, pose, crop.camera, light)


@pytest.fixture(scope="session")
def left_hand(right_hand):
    return as_left_hand(right_hand)


@pytest.fixture(params=["left", "right"])
def avatar(request, left_hand, right_hand):
    return {"left": left_hand, "right": right_hand}[request.param]


@pytest.fixture(scope="session")
def pages(left_hand, right_hand):
    return {avatar.side: page_html(avatar, "A <hand>") for avatar in (left_hand, right_hand)}


@pytest.fixture
def shaded(avatar):
    """The same with a shade that only the photo's side sees, in doubt on some skin."""
    light, gaussians = avatar.light, avatar.gaussians
    facing = surface.vertex_normals(avatar._photo_surface(), avatar.hand.faces)
    shade = torch.linspace(0.4, 1.5, len(facing))[:, None].expand(-1, 3)
    own = torch.linspace(0.5, 1.3, len(gaussians.colors))[:, None].expand(-1, 3)
    doubt = (torch.arange(len(facing)) % 3) / 2
    return avatar.with_looks(gaussians._replace(shade=own), light._replace(shade=shade, facing=facing, doubt=doubt))


@pytest.fixture(scope="session", autouse=True)
def small_textures():
    """A large one takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(texture, "SIZE", 128)
        yield
