import json
import sys

import pytest
import torch

from oasis_warp.bench import speed
from oasis_warp.bench.knobs import generic_kernels
from oasis_warp.bench.operators import OPERATORS, forward
from oasis_warp.bench.rows import json_text
from oasis_warp.bench.scenes import hand_scenes

CPU_ONCE = speed.RunOptions(device=torch.device("cpu"), repeats=2)


@pytest.fixture(scope="module")
def mesh():
    return hand_scenes(32)[1]


@pytest.mark.slow
def test_every_way_is_timed_in_every_pass_and_all_agree(small):
    rows = speed.measure_operator(OPERATORS["rasterization"], small, CPU_ONCE)
    assert [(r.pass_, r.way) for r in rows] == [
        (pass_, way) for pass_ in ("forward", "forward + backward") for way in ("warp", "scalar", "torch")
    ]
    for row in rows:
        assert row.rel_l2 < 5e-6
        assert (row.gradient_rel_l2 is None) == (row.pass_ == "forward")
        assert row.gradient_rel_l2 is None or row.gradient_rel_l2 < 1e-3
        assert row.over_yardstick > 0
        assert (row.over_warp == 1) == (row.way == "warp")


@pytest.mark.parametrize("name", OPERATORS)
def test_generic_kernels_give_float32_answers_of_their_own(name, small, mesh):
    operator = OPERATORS[name]
    scene = operator.prepare(small if operator.scene is type(small) else mesh)
    vectors = operator.comparable(forward(operator.call, scene, {}))
    with generic_kernels():
        scalars = operator.comparable(forward(operator.call, scene, {}))
    again = operator.comparable(forward(operator.call, scene, {}))
    for a, b, c in zip(vectors, scalars, again, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
        assert torch.equal(a, c)  # and afterwards everything is as it was


def test_generic_kernels_answer_no_wherever_an_operator_asks_for_vectors():
    def answers():
        modules = [m for name, m in sys.modules.items() if name.startswith("oasis_warp.ops.")]
        return [m.has_vectors(torch.zeros(1)) for m in modules if hasattr(m, "has_vectors")]

    assert len(answers()) > 3
    assert all(answers())
    with generic_kernels():
        assert not any(answers())


def test_rows_are_plain_json(small):
    rows = speed.measure_operator(OPERATORS["blend_colors"], small, CPU_ONCE)
    records = json.loads(json_text(rows))
    assert [r["way"] for r in records] == ["warp", "torch"] * 2  # sparse products are torch's: nothing to vectorise
    assert {r["pass"] for r in records} == {"forward", "forward + backward"}
