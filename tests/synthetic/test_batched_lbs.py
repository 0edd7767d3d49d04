import pytest
import torch

from oasis_warp.synthetic.ops.batched_lbs import batched_lbs


def _case(device, batch=3, n=50, joints=4, correctives=6, knuckles=5):
    random = torch.Generator().manual_seed(0)
    sizes = [(batch, n, 3), (n, 3, correctives), (batch, correctives), (n, 3), (n, knuckles), (batch, knuckles),
             (n, joints), (batch, joints, 3, 3), (batch, joints, 3)]  # fmt: skip
    case = [torch.randn(*size, generator=random).to(device) for size in sizes]
    case[6][:, 1] = 0  # a bone that moves nobody
    return case


def test_flesh_is_displaced_then_carried_by_its_bones(device):
    case = _case(device)
    rest, displacements, strengths, normals, rises, knuckles, weights, rotations, shifts = (t.double() for t in case)
    moved = rest + torch.einsum("vdc,bc->bvd", displacements, strengths)
    moved = moved + torch.einsum("vk,bk->bv", rises, knuckles)[..., None] * normals
    carried = torch.einsum("bjde,bve->bvjd", rotations, moved) + shifts[:, None]
    wanted = torch.einsum("vj,bvjd->bvd", weights, carried)
    torch.testing.assert_close(batched_lbs(*case).double(), wanted, atol=1e-4, rtol=1e-5)


def test_a_hand_has_the_same_bits_in_any_batch(device):
    case = _case(device)
    alone = [t[2:] if k in (0, 2, 5, 7, 8) else t for k, t in enumerate(case)]
    assert torch.equal(batched_lbs(*alone), batched_lbs(*case)[2:])


def test_wrong_shapes_are_named(as_shipped):
    case = _case("cpu")
    case[5] = case[5][:, :2]
    with pytest.raises(ValueError, match="knuckles"):
        batched_lbs(*case)
