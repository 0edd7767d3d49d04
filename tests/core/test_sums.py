import torch

from oasis_warp.core import surface
from oasis_warp.core.sums import add_at


def test_rows_are_added_at_their_indices_and_pass_gradients(device):
    values = torch.arange(6.0, device=device).view(3, 2).requires_grad_()
    index = torch.tensor([1, 0, 1], device=device, dtype=torch.int32)
    total = add_at(torch.ones(2, 2, device=device), index, values)
    assert total.tolist() == [[3, 4], [5, 7]]
    (gradient,) = torch.autograd.grad((total * torch.tensor([[1.0, 2.0], [3.0, 4.0]], device=device)).sum(), values)
    assert gradient.tolist() == [[3, 4], [1, 2], [3, 4]]


def test_normals_and_smoothed_values_have_the_same_bits_on_every_run(hand, device):
    """Atomics of `index_add` on CUDA add in any order, and reconstructions differed in their last bits."""
    points, faces = hand.template.to(device), hand.faces.to(device)
    edges = surface.mesh_edges(faces)
    first = surface.vertex_normals(points, faces), surface.smooth_over_mesh(points, edges, 5)
    for _ in range(20):
        again = surface.vertex_normals(points, faces), surface.smooth_over_mesh(points, edges, 5)
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
