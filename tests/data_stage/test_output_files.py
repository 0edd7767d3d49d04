import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from disk import full_disk

from oasis_warp.core.errors import InputError
from oasis_warp.data.output_files import new_folder, output_file, output_folder, remove_leftovers, write_file


def everything(folder: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


def fill(folder: Path) -> None:
    (folder / "a.txt").write_text("new a")
    (folder / "b.txt").write_text("new b")


def test_a_file_appears_only_when_the_block_ends(tmp_path):
    with output_file(tmp_path / "out.txt") as part:
        part.write_text("whole")
        assert not (tmp_path / "out.txt").exists()
        assert part.suffix == ".txt"
    assert everything(tmp_path) == {"out.txt": b"whole"}


def test_a_new_file_has_the_permissions_that_the_user_asked_for(tmp_path):
    write_file(tmp_path / "out.txt", b"")
    (tmp_path / "plain.txt").touch()
    assert (tmp_path / "out.txt").stat().st_mode == (tmp_path / "plain.txt").stat().st_mode


def test_a_link_keeps_pointing_to_the_file_that_is_replaced(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_file(tmp_path / "link.txt", b"new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_bytes() == b"new"


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, InputError])
def test_an_interrupted_file_leaves_the_old_one(tmp_path, error):
    (tmp_path / "out.txt").write_text("old")
    with pytest.raises(error), output_file(tmp_path / "out.txt") as part:
        part.write_text("half")
        raise error
    assert everything(tmp_path) == {"out.txt": b"old"}


def test_a_folder_appears_whole(tmp_path):
    with output_folder(tmp_path / "out") as part:
        fill(part)
        assert not (tmp_path / "out").exists()
    assert everything(tmp_path) == {"out": None, "out/a.txt": b"new a", "out/b.txt": b"new b"}


def test_an_existing_folder_keeps_the_files_that_are_not_written_again(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "a.txt").write_text("old a")
    with output_folder(tmp_path) as part:
        fill(part)
        assert (tmp_path / "a.txt").read_text() == "old a"
    assert everything(tmp_path) == {"mine.txt": b"mine", "a.txt": b"new a", "b.txt": b"new b"}


@pytest.mark.parametrize("there", [True, False])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, InputError])
def test_an_interrupted_folder_leaves_everything_as_it_was(tmp_path, there, error):
    if there:
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "a.txt").write_text("old a")
    before = everything(tmp_path)
    with pytest.raises(error), output_folder(tmp_path / "out") as part:
        fill(part)
        raise error
    assert everything(tmp_path) == before


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_told_and_leaves_nothing(tmp_path, monkeypatch, code):
    def fail(fd):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fail)  # where file systems that delay their writes report it
    with pytest.raises(InputError, match="no room left"):
        write_file(tmp_path / "out.txt", b"whole")
    with pytest.raises(InputError, match="no room left"), output_folder(tmp_path / "out") as part:
        fill(part)
    assert everything(tmp_path) == {}


def test_a_disk_that_fills_up_while_writing_is_told_and_leaves_nothing(tmp_path):
    with full_disk(1000):
        with pytest.raises(InputError, match="no room left"):
            write_file(tmp_path / "out.txt", bytes(5000))
        with pytest.raises(InputError, match="no room left"), output_folder(tmp_path / "out") as part:
            (part / "small.txt").write_bytes(bytes(10))
            (part / "large.txt").write_bytes(bytes(5000))
    assert everything(tmp_path) == {}


def test_an_error_names_the_place_that_the_user_knows(tmp_path):
    with full_disk(1000), pytest.raises(InputError) as caught, output_folder(tmp_path / "out") as part:
        write_file(part / "large.txt", bytes(5000))
    assert str(caught.value).startswith(f"{tmp_path / 'out' / 'large.txt'}: no room left")


def test_a_place_that_cannot_be_written_is_refused_before_the_work_begins(tmp_path):
    (tmp_path / "file").touch()
    for writer in (output_file, output_folder):
        with pytest.raises(InputError, match="found a file; choose another name"), writer(tmp_path / "file" / "out"):
            pytest.fail("the block must not run")
        with pytest.raises(InputError, match="too long for this disk; choose a"), writer(tmp_path / ("a" * 256)):
            pytest.fail("the block must not run")
    with pytest.raises(InputError, match="found a folder; add a file name"), output_file(tmp_path):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match="found a device or pipe"), output_file("/dev/null"):
        pytest.fail("the block must not run")
    with pytest.raises(InputError, match="found a file; choose another name"), output_folder(tmp_path / "file"):
        pytest.fail("the block must not run")


@pytest.mark.parametrize("writer", [output_file, output_folder])
def test_missing_folders_are_made_and_removed_again_when_the_work_fails(tmp_path, writer):
    place = tmp_path / "new" / "newer" / "out"
    with pytest.raises(RuntimeError), writer(place):
        raise RuntimeError
    assert everything(tmp_path) == {}
    with writer(place):
        pass
    assert place.exists()


@pytest.mark.parametrize("name", ["n" * 251 + ".png", "\N{RAISED HAND}" * 62 + ".png", "[/b].png"])
def test_names_as_long_as_the_disk_allows_can_be_written(tmp_path, name):
    write_file(tmp_path / name, b"whole")
    with output_folder(tmp_path / "f" / name.removesuffix(".png")) as part:
        fill(part)
    assert (tmp_path / name).read_bytes() == b"whole"
    assert (tmp_path / "f" / name.removesuffix(".png") / "b.txt").exists()


KILLED = """
import os, signal, sys
from pathlib import Path
from oasis_warp.data.output_files import output_file, output_folder
kind, place, *others = sys.argv[1:]
while others and os.fork():  # a process for each
    assert os.waitstatus_to_exitcode(os.wait()[1]) == -signal.SIGKILL
    kind, place, *others = others
place = Path(place)
replace = os.replace
def stop(source, final):
    if kind == "commit" and Path(final).name == "b.txt":
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, final)
os.replace = stop
with (output_file if kind == "file" else output_folder)(place) as part:
    if kind == "file":
        part.write_text("half")
    else:
        (part / "a.txt").write_text("new a")
        (part / "b.txt").write_text("new b")
    if kind != "commit":
        os.kill(os.getpid(), signal.SIGKILL)
"""


def killed(*kinds_and_places: str | Path) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, *map(str, kinds_and_places)], capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr


def test_the_next_run_removes_what_a_killed_one_left(tmp_path):
    (tmp_path / "there").mkdir()
    killed("file", tmp_path / "x.png", "folder", tmp_path / "new", "folder", tmp_path / "there")
    assert len([name for name in everything(tmp_path) if name.endswith((".part", ".part.png"))]) == 3
    (tmp_path / ".mine.png").touch()
    write_file(tmp_path / "x.png", b"whole")
    for folder in ("new", "there"):
        with output_folder(tmp_path / folder) as part:
            fill(part)
    assert not [name for name in everything(tmp_path) if ".part" in name]
    assert (tmp_path / ".mine.png").exists()


def test_files_that_were_whole_when_their_run_was_killed_appear_with_the_next(tmp_path):
    (tmp_path / "a.txt").write_text("old a")
    (tmp_path / "b.txt").write_text("old b")
    killed("commit", tmp_path)
    with pytest.raises(RuntimeError), output_folder(tmp_path):
        assert (tmp_path / "a.txt").read_text() == "new a"
        assert (tmp_path / "b.txt").read_text() == "new b"
        raise RuntimeError
    assert everything(tmp_path) == {"a.txt": b"new a", "b.txt": b"new b"}


def test_a_run_that_goes_on_keeps_its_temporary_files(tmp_path):
    with output_file(tmp_path / "x.png") as part, output_folder(tmp_path / "out") as folder:
        part.write_text("slow")
        write_file(tmp_path / "x.png", b"quick")
        with output_folder(tmp_path / "out") as other:
            (other / "a.txt").write_text("quick")
        assert part.exists() and folder.exists()
    assert (tmp_path / "x.png").read_text() == "slow"
    assert everything(tmp_path / "out") == {"a.txt": b"quick"}


def test_nothing_is_moved_where_a_folder_stands_in_the_way_of_a_file(tmp_path):
    (tmp_path / "b.txt").mkdir()
    with pytest.raises(InputError, match="found a folder"), output_folder(tmp_path) as part:
        fill(part)
    assert everything(tmp_path) == {"b.txt": None}


def test_a_closed_folder_is_refused_before_the_work_begins(tmp_path, monkeypatch):
    tmp_path.chmod(0o500)
    if os.access(tmp_path, os.W_OK):  # root may write anywhere

        def refuse(self, *args, **kwargs):
            raise PermissionError(errno.EACCES, "Permission denied", str(self))

        monkeypatch.setattr(Path, "mkdir", refuse)
        monkeypatch.setattr(Path, "touch", refuse)
    for writer in (output_file, output_folder):
        with pytest.raises(InputError, match=r"cannot be written \(Permission denied\)"), writer(tmp_path / "out"):
            pytest.fail("the block must not run")
    tmp_path.chmod(0o700)


def test_an_error_that_has_nothing_to_do_with_the_output_passes_unchanged(tmp_path):
    for writer in (output_file, output_folder):
        with pytest.raises(FileNotFoundError), writer(tmp_path / "out"):
            (tmp_path / "some input").read_text()
    assert everything(tmp_path) == {}


def test_of_two_runs_that_make_a_new_folder_the_first_makes_it(tmp_path):
    with new_folder(tmp_path / "ab" / "key") as late:
        (late / "file").write_text("late")
        with new_folder(tmp_path / "ab" / "key") as first:
            (first / "file").write_text("first")
    assert [path.read_text() for path in tmp_path.rglob("*") if path.is_file()] == ["first"]


def test_what_killed_runs_left_of_any_output_can_be_removed(tmp_path):
    for name in (".one.01234567.part", ".two.89abcdef.part.json", "whole", ".hidden"):
        (tmp_path / name).touch()
    with output_file(tmp_path / "now") as part:
        remove_leftovers(tmp_path)
        assert {path.name for path in tmp_path.iterdir()} == {part.name, "whole", ".hidden"}
