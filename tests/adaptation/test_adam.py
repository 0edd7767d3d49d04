import re
from pathlib import Path

import pytest
import torch

import oasis_warp.adaptation
from oasis_warp.adaptation.adam import Adam


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_have_the_bits_of_torchs(dtype):
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(shape, generator=generator, dtype=dtype) for shape in ((7, 3), (5,))]
    found, want = ([start.clone().requires_grad_() for start in starts] for _ in range(2))
    ours, theirs = Adam(found, 0.01), torch.optim.Adam(want, lr=0.01)
    for k in range(20):
        losses = [((a * a).sum() * (1 + k) + b.sin().sum() * a[0, 0]) for a, b in (found, want)]
        ours.step(losses[0])
        theirs.zero_grad()
        losses[1].backward()
        theirs.step()
    assert all(torch.equal(a, b) for a, b in zip(found, want, strict=True))


def test_fitting_a_photo_does_not_load_torchs_compiler():
    # Any optimiser of torch imports torch._dynamo, a tenth of a first run.
    for folder in oasis_warp.adaptation.__path__:
        users = [file.name for file in Path(folder).glob("*.py") if re.search(r"= torch\.optim\.", file.read_text())]
        assert not users
