import pytest
import torch

from oasis_warp.core import backgrounds
from oasis_warp.core.backgrounds import plain_background

COLOR = (0.25, 0.5, 1.0)


def test_every_camera_gets_the_color(device):
    for dtype in (torch.float32, torch.float64):
        made = plain_background(COLOR, 2, torch.zeros(1, dtype=dtype, device=device))
        assert torch.equal(made, torch.tensor([COLOR, COLOR], dtype=dtype, device=device))


def test_one_color_is_one_tensor_and_others_are_others(device):
    like = torch.zeros(3, device=device)
    first = plain_background(COLOR, 1, like)
    assert plain_background(COLOR, 1, like + 1) is first
    others = [plain_background((0.25, 0.5, 0.0), 1, like), plain_background(COLOR, 1, like.double())]
    assert all(other is not first for other in others) and len(plain_background(COLOR, 2, like)) == 2


def test_what_inference_mode_made_can_be_saved_for_a_gradient(monkeypatch):
    monkeypatch.setattr(backgrounds, "_kept", {})
    with torch.inference_mode():
        made = plain_background(COLOR, 1, torch.zeros(1))
    leaf = torch.ones(3, requires_grad=True)
    assert torch.equal(torch.autograd.grad((leaf * made).sum(), leaf)[0], made[0])


def test_a_traced_call_neither_keeps_nor_gets_what_is_kept(monkeypatch):
    monkeypatch.setattr(backgrounds, "_kept", {})
    like = torch.zeros(1)
    with torch.device("meta"):  # a mode, which may be watching
        made = plain_background(COLOR, 2, like)
    assert torch.equal(made, torch.tensor([COLOR, COLOR])) and not backgrounds._kept


def test_no_more_is_kept_than_the_limit(monkeypatch):
    monkeypatch.setattr(backgrounds, "_kept", {})
    like = torch.zeros(1)
    for value in range(backgrounds.MAX_KEPT + 3):
        assert plain_background((value / 7,), 1, like).item() == pytest.approx(value / 7)
    assert len(backgrounds._kept) == backgrounds.MAX_KEPT


@pytest.mark.gpu
def test_a_graph_that_is_captured_fills_its_own(monkeypatch):
    monkeypatch.setattr(backgrounds, "_kept", {})
    like = torch.zeros(1, device="cuda")
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        made = plain_background(COLOR, 1, like)
    assert not backgrounds._kept
    graph.replay()
    assert made.tolist() == [list(COLOR)]
