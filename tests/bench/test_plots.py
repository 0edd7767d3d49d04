import pytest
from gpu_rows import KERNELS, SPEED, STUDY

from oasis_warp.bench import plots
from oasis_warp.bench.speed import SpeedRow

OPERATOR = SpeedRow(
    op="skin", pass_="forward", way="torch", scene="hand", gaussians=10, faces=None, width=64, height=64,
    device="a CPU", threads=1, median_ms=2.5, iqr_ms=0.1, fastest_ms=2.0, cpu_ms=2.0, first_ms=9.0, repeats=5,
    peak_mb=None, over_yardstick=0.2, over_warp=3.0, rel_l2=1e-7, gradient_rel_l2=None, seed=0, commit="", versions="",
)  # fmt: skip


@pytest.mark.parametrize(
    ("axis", "amount", "name"),
    [("gaussians", 1_000, "1k"), ("gaussians", 3_162_278, "3.16M"), ("gaussians", 10**7, "10M"),
     ("pixels", 512**2, "512²"), ("views", 64, "64")],
)  # fmt: skip
def test_amounts_are_written_short(axis, amount, name):
    assert plots.amount_name(axis, amount) == name


def test_pictures_appear_whole_and_nothing_else(tmp_path):
    pytest.importorskip("matplotlib")
    for name, plot, rows in (
        ("speed", plots.plot_speed, SPEED), ("operators", plots.plot_speed, [OPERATOR]),
        ("scaling", plots.plot_scaling, STUDY), ("roofline", plots.plot_roofline, KERNELS),
    ):  # fmt: skip
        plot(rows, tmp_path / f"{name}.png")
        plot(rows, tmp_path / f"{name}.svg")
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == 8
    words = {name: (tmp_path / f"{name}.svg").read_text() for name in ("speed", "scaling", "roofline")}
    assert all(word in words["speed"] for word in ("37k at 512 x 512", "gsplat, wall", "warp, GPU", "0.25"))
    assert all(word in words["scaling"] for word in ("ns a Gaussian", "us a view", "256²"))
    assert "blend_tiles_backward_3" in words["roofline"]
    assert "vectorized_elementwise_kernel" not in words["roofline"]  # nothing is known of it


def test_a_picture_that_is_interrupted_leaves_the_old_one(monkeypatch, tmp_path):
    figure = pytest.importorskip("matplotlib.figure")

    def interrupt(self, part, **_):
        part.write_bytes(b"half of it")
        raise KeyboardInterrupt

    (tmp_path / "scaling.png").write_bytes(b"old")
    monkeypatch.setattr(figure.Figure, "savefig", interrupt)
    with pytest.raises(KeyboardInterrupt):
        plots.plot_scaling(STUDY, tmp_path / "scaling.png")
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [b"old"]
