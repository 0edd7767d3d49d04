import pytest
import torch

from oasis_warp.bench import roofline
from oasis_warp.bench.counts import count, count_mesh
from oasis_warp.bench.cuda import KernelTime
from oasis_warp.bench.roofline import MESH_KERNELS, PICTURE_KERNELS, Ceilings, Work, assess
from oasis_warp.bench.scenes import hand_scenes

ABOUT = {"device": "a GPU", "commit": "", "versions": ""}
CEILINGS = Ceilings(gb_s=4000.0, gflop_s=50_000.0)
MODELS = {"moves": lambda n: Work(8.0 * n, 1.0 * n), "thinks": lambda n: Work(8.0 * n, 1000.0 * n)}


def test_a_kernel_is_measured_by_the_nearer_ceiling():
    times = [KernelTime("moves", 1.0, 10.0), KernelTime("thinks", 2.0, 40.0)]
    moves, thinks = assess("case", times, MODELS, 10**6, CEILINGS, ABOUT)
    assert (moves.bytes, moves.flops, moves.bound) == (8e6, 1e6, "bytes")
    assert moves.floor_us == pytest.approx(2.0)  # 8 MB at 4 TB/s
    assert moves.gb_s == pytest.approx(800.0)
    assert moves.gflop_s == pytest.approx(100.0)
    assert moves.share == pytest.approx(0.2)
    assert thinks.bound == "flops"
    assert thinks.floor_us == pytest.approx(20.0)  # 1 GFLOP at 50 TFLOP/s
    assert thinks.share == pytest.approx(0.5)
    assert thinks.launches == 2


def test_a_kernel_without_a_formula_has_its_time_alone():
    (row,) = assess("case", [KernelTime("Memset", 1.0, 3.0)], MODELS, 10**6, CEILINGS, ABOUT)
    assert (row.us, row.bytes, row.gb_s, row.floor_us, row.share, row.bound) == (3.0, None, None, None, None, "")


def test_formulas_grow_with_the_scene():
    small, large = (hand_scenes(size)[0] for size in (64, 256))
    for name, model in PICTURE_KERNELS.items():
        one, other = model(count(small)), model(count(large))
        assert one.bytes > 0, name
        assert one.flops > 0, name
        assert other.bytes >= one.bytes, name
    counts = count_mesh(hand_scenes(64)[1])
    assert all(model(counts).bytes > 0 for model in MESH_KERNELS.values())


def test_gathering_and_projecting_in_one_moves_less_than_both():
    work = count(hand_scenes(128)[0])
    gather, project, fused = (
        PICTURE_KERNELS[name](work)
        for name in ("gather_records_3", "project_gaussians_backward", "gather_project_backward")
    )
    assert fused.bytes < gather.bytes + project.bytes
    assert fused.flops == gather.flops + project.flops


def test_drawing_512_pixels_costs_what_was_estimated():
    work = count(hand_scenes(512)[0])
    assert PICTURE_KERNELS["blend_tiles_3"](work).flops == pytest.approx(0.09e9, rel=0.3)
    assert PICTURE_KERNELS["blend_tiles_backward_3"](work).flops == pytest.approx(0.25e9, rel=0.3)
    assert PICTURE_KERNELS["project_gaussians"](work).bytes == 36_881 * 156


@pytest.mark.gpu
def test_the_kernels_of_a_gpu_have_formulas_and_stay_below_the_ceilings():
    rows = roofline.measure_roofline(torch.device("cuda"))
    assert rows
    for case in dict.fromkeys(row.case for row in rows):
        kernels = [row for row in rows if row.case == case]
        known = sum(row.us for row in kernels if row.floor_us is not None)
        assert known > 0.5 * sum(row.us for row in kernels), case
    assert all(row.share < 1.5 for row in rows if row.share is not None and row.us > 2)
    assert rows[0].ceiling_gb_s > 100
