import pytest
import torch
from synthetic import crop_of

from oasis_warp.avatar.observation import observe
from oasis_warp.core.camera import project


@pytest.mark.parametrize("size", [95, 96])
def test_a_vertex_has_the_color_of_the_place_it_projects_to(hand, size):
    crop, _, _ = crop_of(hand, torch.full_like(hand.template, 0.5), size=size)
    x = (torch.arange(size) + 0.5) / size  # of pixel centres
    ramp = torch.stack([x.expand(size, size), x[:, None].expand(size, size), torch.zeros(size, size)], -1)
    seen = observe(hand, crop._replace(image=ramp))
    uv, _ = project(crop.camera, crop.posed.vertices)
    shown = seen.confidence > 0
    assert int(shown.sum()) > 1000
    torch.testing.assert_close(seen.colors[shown, :2], uv[shown] / size, atol=1e-4, rtol=0)
