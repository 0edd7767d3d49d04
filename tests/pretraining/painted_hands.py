"""Training batches of hands painted at random: a stand-in for the synthetic world that costs next to nothing."""

import math
from collections.abc import Iterator

import torch

from oasis_warp.avatar.anchors import OPACITY, place_anchors, vertex_to_gaussians
from oasis_warp.avatar.appearance import label_regions, region_colors
from oasis_warp.avatar.pose import pose_gaussians
from oasis_warp.core.camera import orbit_camera
from oasis_warp.core.types import HandPose, TrainingBatch
from oasis_warp.hand.poses import named_pose
from oasis_warp.hand.skinning import rest_hand, skin
from oasis_warp.render import render

POSES = ("rest", "open", "pinch", "point")


class PaintedHands:
    """A `BatchSource`: skin of any tone with waves of any colour over it, seen from anywhere in four poses."""

    def __init__(self, hand, hands=2, targets=2, size=64):
        self.hand, self.hands, self.targets, self.size = hand, hands, targets, size
        self.regions = label_regions(hand)

    def __call__(self, first_step: int, rank: int, world: int) -> Iterator[TrainingBatch]:
        step = first_step
        while True:
            yield self.batch(step * world + rank)
            step += 1

    def batch(self, number: int) -> TrainingBatch:
        random = torch.Generator().manual_seed(number)
        made = [self._person(random) for _ in range(self.hands)]
        return TrainingBatch(*(torch.stack(parts) for parts in zip(*made, strict=True)))

    def _uniform(self, random, low, high):
        return low + (high - low) * float(torch.rand((), generator=random))

    def _person(self, random):
        hand = self.hand
        rest = rest_hand(hand, 0.5 * torch.randn(len(hand.shape_names), generator=random))
        colors = region_colors(self.regions, math.exp(self._uniform(random, math.log(0.01), math.log(0.3))))
        waves = torch.randn(3, 6, generator=random) * 60
        paint = torch.sin(hand.template @ waves + 6 * torch.rand(6, generator=random)) @ torch.randn(
            6, 3, generator=random
        )
        anchors = place_anchors(hand, rest)
        truth = anchors.with_colors(vertex_to_gaussians((colors + 0.05 * paint).clamp(0, 1), hand.faces, anchors))
        truth = truth._replace(opacities=torch.full_like(truth.opacities, OPACITY))  # a hand does not end at the wrist
        pictures = [self._picture(random, rest, truth) for _ in range(1 + self.targets)]
        image, mask, posed, viewmat, K = pictures[0]
        targets = [torch.stack(parts) for parts in zip(*pictures[1:], strict=True)]
        images, masks, *poses = targets
        return image, mask, posed, viewmat, K, rest.vertices, images, masks, torch.ones_like(masks), *poses

    def _picture(self, random, rest, truth):
        name = POSES[int(torch.randint(len(POSES), (), generator=random))]
        pose = HandPose(named_pose(self.hand, name), torch.eye(3), torch.zeros(3))
        posed = skin(self.hand, rest, pose).vertices
        camera = orbit_camera(posed, self._uniform(random, 0, 2 * math.pi), self._uniform(random, -1.5, 1.5), self.size)
        with torch.no_grad():
            drawn = render(pose_gaussians(truth, self.hand.faces, rest.vertices, posed), camera)
        return drawn.image, drawn.alpha, posed, camera.viewmat, camera.K
