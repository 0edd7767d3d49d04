import json
from dataclasses import replace

import pytest
import torch

from oasis_warp.avatar.quality import SurfaceQuality
from oasis_warp.core.camera import project
from oasis_warp.core.types import Camera, CanonicalGaussians, HandFit, HandPose, Landmarks, Photo
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import hand21, rest_hand, skin
from oasis_warp.hand_avatar import Avatar
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import save_network
from oasis_warp.ops import depth_map
from oasis_warp.reconstruction import Reconstruction

SKIN, GROUND = (200, 150, 120), (30, 60, 90)


@pytest.fixture(scope="session")
def scene(hand):
    """A photo of an open hand that is known exactly, its fit, and an avatar of few Gaussians, quick to draw."""
    shape = torch.zeros(hand.shape_basis.shape[-1])
    # Fingers up, palm to the camera: the hand's -x is the picture's -y, its -y looks to the camera.
    orientation = torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose = HandPose(named_pose(hand, "open"), orientation, torch.tensor([0.0, 0.09, 0.6]))
    K = torch.tensor([[360.0, 0.0, 80.0], [0.0, 360.0, 100.0], [0.0, 0.0, 1.0]])
    camera = Camera(torch.eye(4), K, 160, 200)
    rest = rest_hand(hand, shape)
    posed = skin(hand, rest, pose)
    seen = depth_map(posed.vertices, hand.faces, camera.viewmat, camera.K, camera.width, camera.height)
    mask = (seen.face_ids >= 0).float()
    rgb = torch.where(mask[..., None] > 0, torch.tensor(SKIN), torch.tensor(GROUND)).to(torch.uint8)
    photo = Photo(rgb, None, None, "known.png", 1.0)
    xy, _ = project(camera, hand21(posed, hand))
    landmarks = Landmarks(xy, None, "right", 0.99, 0.98, "network")
    fit = HandFit("right", shape, pose, camera, landmarks, mask, 0.5, 1.5, 0.97, 1.0, ())
    kept = torch.arange(0, len(hand.template), 12)
    n = len(kept)
    gaussians = CanonicalGaussians(
        vertex_index=kept,
        offsets=torch.zeros(n, 3),
        face_index=torch.zeros(0, dtype=torch.int64),
        barycentrics=torch.zeros(0, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4).contiguous(),
        scales=torch.full((n, 3), 0.003),
        opacities=torch.full((n,), 0.9),
        colors=(torch.tensor(SKIN) / 255).expand(n, 3).contiguous(),
    )
    avatar = Avatar(
        side="right",
        shape=shape,
        surface_offsets=torch.zeros_like(hand.template),
        gaussians=gaussians,
        source_pose=pose,
        source_camera=camera,
    )
    return photo, fit, avatar


@pytest.fixture
def made(scene):
    _, fit, avatar = scene
    n = len(avatar.hand.template)
    quality = SurfaceQuality(torch.arange(n) / n, 1 - torch.arange(n) / n)
    seconds, errors = {"landmarks": 0.5, "fit": 0.25}, {"input_psnr_db": 30.0, "mask_iou": 0.97}
    return Reconstruction(avatar, fit, {"name": "learned", "sha256": "0a1b", "step": 7}, seconds, errors, (), quality)


@pytest.fixture
def avatar_file(scene, tmp_path):
    scene[2].save(tmp_path / "avatar.safetensors")
    return tmp_path / "avatar.safetensors"


@pytest.fixture(scope="session")
def weights_file(hand, tmp_path_factory):
    """Of a small network that knows nothing yet."""
    small = replace(COMPACT, width=32, heads=2, n_tokens=16, n_coarse=64, refine_layers=1, head_width=16)
    path = tmp_path_factory.mktemp("weights") / "network.safetensors"
    save_network(path, HandNetwork(small, hand), notes=json.dumps({"step": 7}))
    return path
