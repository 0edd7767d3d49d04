"""The network: photos and posed surfaces in, canonical Gaussians out; the only file that knows the order of parts."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from oasis_warp.avatar.anchors import batch_anchors
from oasis_warp.avatar.observation import CropBatch, Observation, observe_batch
from oasis_warp.avatar.prior import MeanHand, MeanHands
from oasis_warp.core.hand_model import HandModel
from oasis_warp.core.surface import faces_of_vertices
from oasis_warp.network.attention import CoarseLevel, JointAttention, Perceptron, Refinement, VisibilityAttention
from oasis_warp.network.config import NetworkConfig
from oasis_warp.network.encoders import ConvolutionalEncoder, DinoV2Encoder, ImageFeatures
from oasis_warp.network.heads import (
    FACE_LIMITS,
    FACE_OUTPUTS,
    TRUST,
    VERTEX_LIMITS,
    VERTEX_OUTPUTS,
    FeatureOnMesh,
    GaussianHead,
    decode,
    decode_offsets,
)
from oasis_warp.network.tokens import (
    PointEvidence,
    PointFeatures,
    PositionEncoding,
    Tokenizer,
    VisualTokens,
    color_difference,
    encode,
    grid_positions,
)


class Prediction(NamedTuple):
    """Canonical Gaussians of B hands, one for each of V vertices and then one for each of F faces; N = V + F.

    Those that the wrist's fade hides are still there, so that all hands have equally many. Without FoM F is 0.
    """

    offsets: Float[Tensor, "B V 3"]
    barycentrics: Float[Tensor, "B F 3"]
    quats: Float[Tensor, "B N 4"]
    scales: Float[Tensor, "B N 3"]
    opacities: Float[Tensor, "B N"]
    colors: Float[Tensor, "B N 3"]
    anchor_scales: Float[Tensor, "B N 3"]
    """What `scales` started from."""


HAND_LENGTH = 0.2
"""Scale of template coordinates for their encoding [m]: they lie in [-1, 1] then."""
TONE = 7
"""Numbers that say how the photo's skin looks as a whole: log melanin, log gains, mean colour."""


class Described(NamedTuple):
    """Inputs of the heads, for B hands."""

    features: Float[Tensor, "B V C"]
    """Features of the points."""
    colors: Float[Tensor, "B V 3"]
    """Mean colours in the photo's tone."""
    seen: Float[Tensor, "B V 3"] | None
    """With point evidence, what the photo shows instead of them."""


class HandNetwork(nn.Module):
    """The paper's prior network for the hand model `hand`; `config` sets sizes and switches.

    Runs under autocast: attention and perceptrons in the lower precision, geometry and Gaussians in float32.
    """

    faces: Tensor
    rim: Tensor
    vertex_faces: Tensor
    vertex_index: Tensor
    face_index: Tensor
    """All vertices, and all faces that carry a Gaussian: always these tensors, as operators check indices once each."""
    template_encoding: Tensor

    def __init__(self, config: NetworkConfig, hand: HandModel):
        super().__init__()
        self.config = config
        self.hand_name = hand.name
        self._remember(hand)
        width, heads = config.width, config.heads
        if config.backbone == "convolutional":
            self.encoder = ConvolutionalEncoder(config.image_size, width)
            aligned, fine = width, self.encoder.fine_channels
        else:
            self.encoder = DinoV2Encoder(config.backbone, config.image_size)
            aligned, fine = self.encoder.aligned_channels, 0
        direct = config.point_evidence == "on"
        self.level = None if config.n_coarse is None else CoarseLevel(hand, config.n_coarse)
        self.mean_hands = MeanHands(hand)
        self.geometry = Perceptron(6 * config.frequencies, width, width)
        self.global_token = Perceptron(self.encoder.deep_channels + (TONE if direct else 0), width, width)
        self.place = PositionEncoding(width)
        if config.vet == "off":
            self.flatten = nn.Linear(self.encoder.deep_channels, width)
        if config.vet != "off" or direct:
            neighborhood = 1 if config.vet == "no_aggr" else config.neighborhood
            self.point_features = PointFeatures(aligned, fine, width, neighborhood)
        if config.vet == "mlp":
            self.tokenizer = Perceptron(width, 4 * width, width)
        elif config.vet != "off":
            self.tokenizer = Tokenizer(width, heads, config.n_tokens, config.tokenizer == "literal")
        self.point_evidence = PointEvidence(width) if direct else None
        if config.vpia == "off":
            self.fusion = JointAttention(width, heads)
        else:
            self.fusion = VisibilityAttention(width, heads, config.n_tokens, config.vpia == "on")
        self.refinement = Refinement(width, heads, config.refine_layers) if config.refine == "on" else None
        more = TRUST if direct else {}
        self.vertex_head = GaussianHead(width, config.head_width, VERTEX_OUTPUTS | more)
        if config.fom == "on":
            self.feature_on_mesh = FeatureOnMesh(len(hand.faces))
            self.face_head = GaussianHead(width, config.head_width, FACE_OUTPUTS | more)

    def _remember(self, hand: HandModel) -> None:
        """Keep what never changes of the hand; it is not saved with the weights."""
        for name, tensor in {
            "faces": hand.faces,
            "rim": hand.rim,
            "vertex_faces": faces_of_vertices(hand.faces, len(hand.template)),
            "vertex_index": torch.arange(len(hand.template)),
            "face_index": torch.arange(len(hand.faces) if self.config.fom == "on" else 0),
            "template_encoding": encode(hand.template / HAND_LENGTH, self.config.frequencies),
        }.items():
            self.register_buffer(name, tensor, persistent=False)

    def forward(self, inputs: CropBatch) -> Prediction:
        """Canonical Gaussians of every hand of the batch."""
        return self.decode(*self.describe(inputs), inputs.rest)

    def describe(self, inputs: CropBatch) -> Described:
        """All but the heads."""
        with torch.autocast(inputs.image.device.type, enabled=False):
            observation = self.observe(inputs)
            mean = self.mean_hands(observation.colors, observation.confidence)
            seen = None if self.point_evidence is None else color_difference(observation, mean)
        points, local, context = self.tokens(inputs, observation, mean, seen)
        features = self.fuse(points, local, context, observation.visibility)
        if self.refinement is not None:
            features = self.refinement(features, self.level)
        return Described(features, mean.colors, seen)

    def observe(self, inputs: CropBatch) -> Observation:
        """What each photo shows of each vertex."""
        identity = None if self.config.visibility == "literal" else self.vertex_index
        return observe_batch(inputs, self.faces, self.vertex_faces, identity)

    def tokens(
        self, inputs: CropBatch, observation: Observation, mean: MeanHand, seen: Float[Tensor, "B V 3"] | None
    ) -> tuple[Float[Tensor, "B V C"], Float[Tensor, "B M C"], Float[Tensor, "B C"]]:
        """Geometric tokens, local image tokens and the global token; `seen` comes with point evidence."""
        features = self.encoder(inputs.image, inputs.mask)
        geometric = self.geometry(self.template_encoding).expand(len(inputs.image), -1, -1)
        pooled = features.deep.amax((2, 3))
        if self.point_evidence is None or seen is None:
            context = self.global_token(pooled)
            aligned = self._aligned(features, observation) if self.config.vet != "off" else None
            points, visual = geometric, self._visual(features, aligned, None, observation)
        else:
            tone = torch.cat([mean.log_melanin[:, None], mean.log_gain, _mean_color(observation)], dim=1)
            context = self.global_token(torch.cat([pooled, tone.to(pooled.dtype)], dim=1))
            aligned = self._aligned(features, observation)
            visual = self._visual(features, aligned, geometric, observation)
            points = geometric + self.point_evidence(aligned, seen, observation, mean)
            points = points + self.place(observation.uv) * observation.inside[..., None]
        return points, visual.tokens + self.place(visual.centers), context

    def fuse(
        self,
        points: Float[Tensor, "B V C"],
        local: Float[Tensor, "B M C"],
        context: Float[Tensor, "B C"],
        visibility: Float[Tensor, "B V"],
    ) -> Float[Tensor, "B V C"]:
        """Occlusion-aware Gaussian features."""
        if isinstance(self.fusion, VisibilityAttention):
            return self.fusion(points, local, context, visibility)
        if self.level is None:
            return self.fusion(points, local, context)
        coarse = self.level.down(points)
        return points + self.level.up(self.fusion(coarse, local, context) - coarse)

    def decode(
        self,
        features: Float[Tensor, "B V C"],
        colors: Float[Tensor, "B V 3"],
        seen: Float[Tensor, "B V 3"] | None,
        rest: Float[Tensor, "B V 3"],
    ) -> Prediction:
        """Both heads, applied to the anchors on `rest`, the mean colours, and what the photo shows instead of them."""
        raw, n = self.vertex_head(features), features.shape[1]
        barycentrics = features.new_zeros((len(features), 0, 3), dtype=torch.float32)
        on_faces = self.face_head(self.feature_on_mesh(features, self.faces)) if self.config.fom == "on" else None
        with torch.autocast(features.device.type, enabled=False):
            quats, scales, fade = batch_anchors(rest, self.faces, self.vertex_faces, self.rim)
            attributes = decode(raw, quats[:, :n], scales[:, :n], fade[:, :n], colors, seen, VERTEX_LIMITS)
            if on_faces is None:
                return Prediction(decode_offsets(raw), barycentrics, *attributes, scales[:, :n])
            barycentrics = on_faces.pop("barycentrics").softmax(-1)
            colors = colors[:, self.faces].mean(2)
            seen = None if seen is None else seen[:, self.faces].mean(2)
            more = decode(on_faces, quats[:, n:], scales[:, n:], fade[:, n:], colors, seen, FACE_LIMITS)
            both = (torch.cat(parts, dim=1) for parts in zip(attributes, more, strict=True))
            return Prediction(decode_offsets(raw), barycentrics, *both, scales)

    def _aligned(self, features: ImageFeatures, observation: Observation) -> Tensor:
        return self.point_features(features, observation.uv, observation.inside)

    def _visual(
        self, features: ImageFeatures, aligned: Tensor | None, geometric: Tensor | None, observation: Observation
    ) -> VisualTokens:
        if self.config.vet == "off" or aligned is None:
            tokens = self.flatten(features.deep.flatten(2).transpose(1, 2))
            positions = grid_positions(*features.deep.shape[2:], like=observation.uv)
            return VisualTokens(tokens, positions.expand(len(tokens), -1, -1))
        if isinstance(self.tokenizer, Tokenizer):
            return self.tokenizer(aligned, geometric, observation.uv, observation.inside)
        if self.level is None:
            return VisualTokens(self.tokenizer(aligned), observation.uv)
        return VisualTokens(self.tokenizer(self.level.down(aligned)), self.level.down(observation.uv))


def _mean_color(observation: Observation) -> Float[Tensor, "B 3"]:
    """Mean colour of what is seen well."""
    weight = observation.confidence[..., None]
    return (weight * observation.colors).sum(1) / weight.sum(1).clamp_min(1)
