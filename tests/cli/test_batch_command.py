import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from disk import full_disk

from oasis_warp.cli import batch, batch_work, main
from oasis_warp.cli.batch_work import MAX_TRIES, Order, make_avatars
from oasis_warp.core.config import ReconstructConfig
from oasis_warp.core.errors import InputError

AVATAR = {"avatar.safetensors", "report.json", "row.json"}


@pytest.fixture
def order(tmp_path):
    (tmp_path / "photos").mkdir()
    return Order(source=tmp_path / "photos", out=tmp_path / "out", config=ReconstructConfig(prior="none"))


@pytest.fixture
def photo(order):
    def draw(name, shade):
        cv2.imwrite(str(order.source / name), np.full((40, 40, 3), shade, np.uint8))
        return name

    return draw


@pytest.fixture
def pipeline(monkeypatch, made):
    """The pipeline, already knowing the answer, which the brightness of the photo is."""

    def answer(photo, config, *, prior):
        shade = int(photo.rgb[0, 0, 0])
        calls.append(shade)
        if shade == 1:
            raise InputError(f"{photo.name}: found no hand; give another photo.")
        if shade == 2:
            raise RuntimeError("a fault\nof our own")
        return made

    calls = []
    monkeypatch.setattr(batch_work, "reconstruct", answer)
    monkeypatch.setattr(batch_work, "prepare", lambda order: None)
    return calls


def test_settings_name_the_hand_model_and_not_where_its_files_lie(order, tmp_path, monkeypatch):
    """A path is no JSON, and avatars are the same wherever MANO's files were read from; workers need it absolute."""
    monkeypatch.chdir(tmp_path)
    configs = [ReconstructConfig(prior="none", hand_model="mano", mano_dir=Path(name)) for name in ("here", "there")]
    orders = [Order(source=order.source, out=order.out, config=config) for config in configs]
    assert orders[0].digest == orders[1].digest != order.digest
    assert batch._absolute(configs[0]).mano_dir == tmp_path / "here"


def rows(order, names):
    return batch_work.read_rows(order.rows_file(names))


def folders(order):
    return {path.name: {file.name for file in path.iterdir()} for path in order.out.glob("avatars/??/*")}


def test_every_photo_gets_a_line_and_those_with_an_answer_a_folder_of_their_own(pipeline, photo, order):
    names = [photo("hand.png", 9), photo("none.png", 1), photo("fault.png", 2), "gone.png", photo("copy.png", 9)]
    reports = []
    counts = make_avatars(np.array(names), order, lambda counts: reports.append(dict(counts)))
    assert counts == reports[-1] == {"made": 1, "refused": 1, "failed": 2, "kept": 1} and len(reports) == 5
    hand, none, fault, gone, copy = rows(order, names)
    assert (hand["status"], hand["side"], hand["input_psnr_db"]) == ("made", "right", 30.0)
    assert (none["status"], none["said"]) == ("refused", "none.png: found no hand; give another photo.")
    assert fault["said"].endswith("a fault\\nof our own") and "RuntimeError in test_batch_command.py:" in fault["said"]
    assert gone["status"] == "failed" and "gone.png: cannot be read (No such file" in gone["said"]
    assert copy["key"] == hand["key"]
    assert folders(order) == {hand["key"]: AVATAR, none["key"]: {"row.json"}}
    assert pipeline == [9, 1, 2] and not list((order.out / "tries").iterdir())


def test_only_what_failed_and_photos_that_changed_are_worked_on_again(pipeline, photo, order):
    names = [photo("a.png", 9), photo("b.png", 1), photo("c.png", 2), photo("d.png", 50)]
    make_avatars(names, order)
    photo("d.png", 60)
    pipeline.clear()
    assert make_avatars(names, order) == {"made": 1, "refused": 0, "failed": 1, "kept": 2}
    assert pipeline == [2, 60]
    pipeline.clear()
    assert make_avatars(names[:2], order)["kept"] == 2  # another task finds them by their content
    other = Order(source=order.source, out=order.out, config=ReconstructConfig(prior="none", seed=1))
    assert make_avatars(names[:1], other)["made"] == 1 and pipeline == [9]


def test_a_photo_that_ends_its_process_again_and_again_is_left_out(pipeline, photo, order, monkeypatch):
    def die(*_, **__):
        raise SystemExit

    names = [photo("bomb.png", 7), photo("a.png", 9)]
    with monkeypatch.context() as patch:
        patch.setattr(batch_work, "reconstruct", die)
        for _ in range(MAX_TRIES):
            with pytest.raises(SystemExit):
                make_avatars(names, order)
    assert make_avatars(names, order) == {"made": 1, "refused": 0, "failed": 1, "kept": 0}
    assert "its process ended 3 times" in rows(order, names)[0]["said"]


def test_a_full_disk_ends_the_work_and_refuses_no_photo(pipeline, photo, order):
    name = photo("a.png", 9)
    with full_disk(2_000), pytest.raises(InputError, match="free some"):
        make_avatars([name], order)
    assert not folders(order) and not rows(order, [name])


def test_a_worker_of_another_version_is_refused(order):
    other = Order(source=order.source, out=order.out, config=order.config, version="0.0.1")
    with pytest.raises(InputError, match="the run was started by 0.0.1; install the same version"):
        make_avatars([], other)


def test_photos_are_found_at_any_depth_or_on_a_list_but_not_among_results(tmp_path):
    for name in ("b.PNG", "sub/a.jpg", "notes.md", ".hidden/c.png", "out/avatars/d.png", "sub/.e.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert batch.find_photos(tmp_path, tmp_path / "out") == ["b.PNG", "sub/a.jpg"]
    listed = tmp_path / "list.txt"
    listed.write_text("sub/a.jpg\n\n b.PNG \nsub/a.jpg\n")
    assert batch.find_photos(listed, tmp_path / "out") == ["sub/a.jpg", "b.PNG"]
    for wrong in (tmp_path / "b.PNG", tmp_path / "nothing", tmp_path / ".hidden" / "deeper"):
        with pytest.raises(InputError, match="expected a folder or a .txt file"):
            batch.find_photos(wrong, tmp_path / "out")


@pytest.mark.parametrize(("n", "workers", "size"), [(1, 4, 1), (40, 2, 1), (1000, 2, 31), (1_000_000, 100, 256)])
def test_few_photos_are_shared_by_all_workers_and_many_by_few_tasks(n, workers, size):
    tasks = batch.split_tasks([str(k) for k in range(n)], workers)
    assert [name for task in tasks for name in task] == [str(k) for k in range(n)]
    assert {len(task) for task in tasks[:-1]} <= {size} and len(tasks[-1]) <= size


@pytest.mark.parametrize(
    ("options", "output"),
    [
        (["--workers", "0"], "--workers 0: expected 1 or more"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], "exclude each other"),
        ([], "pip install 'oasis-warp[batch]'"),
    ],
)
def test_wrong_options_and_missing_packages_are_told(photo, order, capsys, monkeypatch, options, output):
    monkeypatch.setitem(sys.modules, "distributed", None)
    photo("a.png", 9)
    assert main(["batch", str(order.source), "-o", str(order.out), "--prior", "none", *options]) == 2
    assert output in capsys.readouterr().err


def test_a_batch_ends_with_a_manifest_and_counts_of_what_was_said(pipeline, photo, order, monkeypatch, capsys):
    class Cluster:
        def __enter__(self):
            return None, 2

        def __exit__(self, *_):
            left = order.out / "avatars" / "ab" / ".abcd.01234567.part"  # of a worker that was killed
            left.mkdir(parents=True)

    def work(client, tasks, order, reports):
        counts = [make_avatars(names, order) for names in tasks]
        reports(5, 0)
        return sum(sum(count.values()) - count["kept"] for count in counts)

    monkeypatch.setattr(batch, "open_cluster", lambda *_: Cluster())
    monkeypatch.setattr(batch, "work", work)
    names = [photo(f"{k}.png", shade) for k, shade in enumerate((9, 1, 10, 11, 12))]
    command = ["batch", str(order.source), "-o", str(order.out), "--prior", "none"]
    assert main(command) == 0
    manifest = [json.loads(line) for line in (order.out / "manifest.jsonl").read_text().splitlines()]
    assert [row["photo"] for row in manifest] == names
    assert {row["key"] for row in manifest} == folders(order).keys() and not list(order.out.rglob(".*"))
    summary = json.loads((order.out / "summary.json").read_text())
    assert summary["photos"] == {"made": 4, "refused": 1, "failed": 0} and summary["this_run"]["photos"] == 5
    assert "found no hand; give another photo." in capsys.readouterr().out
    photo("5.png", 2)
    assert main(command) == 2  # one failed


def test_the_work_of_a_cluster_is_counted_and_a_lost_scheduler_told(pipeline, photo, order):
    distributed = pytest.importorskip("distributed")
    names = [photo(f"{k}.png", shade) for k, shade in enumerate((9, 1, 10))]
    reports = []
    workers = {"processes": False, "n_workers": 2, "threads_per_worker": 1}
    with distributed.Client(**workers, dashboard_address="127.0.0.1:0") as client:  # 8787 may be taken
        tasks = [names[:2], names[2:]]
        assert batch.work(client, tasks, order, lambda *counts: reports.append(counts)) == 3
        assert reports[-1] == (3, 0)
        assert batch.work(client, tasks, order, lambda *counts: reports.append(counts)) == 0
        assert reports[-1] == (0, 3)
        wrong = Order(source=order.source, out=order.source / "0.png", config=order.config)
        with pytest.raises(InputError, match="expected the folder"):
            batch.work(client, tasks, wrong, lambda *counts: None)


ENVIRONMENT = """
import os
from oasis_warp.cli import batch
if __name__ == "__main__":
    with batch.open_cluster(1, None, "cpu") as (client, _):
        (found,) = client.run(lambda: dict(os.environ)).values()
    assert {name: int(found[name]) for name in batch.MALLOC} == batch.MALLOC, found
"""


@pytest.mark.slow
def test_workers_keep_the_memory_that_they_were_given(tmp_path):
    """Dask's own threshold makes page faults of two fifths of their time."""
    pytest.importorskip("distributed")
    (tmp_path / "environment.py").write_text(ENVIRONMENT)
    subprocess.run([sys.executable, str(tmp_path / "environment.py")], check=True, timeout=200)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("victim", ["worker", "client"])
def test_nothing_is_lost_double_or_half_when_parts_are_killed(victim):
    pytest.importorskip("distributed")
    script = Path(__file__).parents[1] / "fuzz" / "kill_batch.py"
    command = [sys.executable, str(script), victim, "--count", "1", "--photos", "4"]
    output = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert output["kills"] == 1
    assert not any(output[name] for name in ("half", "lost", "double", "failed", "left")), output
