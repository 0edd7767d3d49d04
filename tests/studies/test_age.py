"""Tables of the documentation say what the kept results say, and which code has measured them."""

import importlib
import re
import shutil

import pytest

from studies import __main__ as command
from studies import age, tables
from studies.harness import ROWS, write_rows
from studies.tables import Column, Section, table

NOTE = re.compile(r"\n\*Measured [^\n]*\*\n(?=<!-- end of)")


def test_pages_hold_what_the_kept_results_say(tmp_path):
    for page in command.DOCS.glob("*.md"):
        shutil.copy(page, tmp_path)
    for name in command.studies():
        study = importlib.import_module(f"studies.{name}")
        if rows := command.load(name, study, age.RESULTS):
            tables.render(study.SECTIONS, rows, tmp_path)
    for page in command.DOCS.glob("*.md"):
        assert NOTE.sub("", (tmp_path / page.name).read_text()) == NOTE.sub("", page.read_text()), page.name


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A study that imports a package, which passes on a function of one file beside another file; a kernel."""
    texts = {
        "studies/count.py": "from oasis_warp import half\n",
        "src/oasis_warp/__init__.py": "from oasis_warp.halves import half\nfrom oasis_warp.other import third\n",
        "src/oasis_warp/halves.py": '"""Half."""\n\ndef half(x):\n    from oasis_kernels.divide.by import by\n',
        "src/oasis_warp/other.py": "third = 3\n",
        "kernels/oasis_kernels/divide/__init__.py": "",
        "kernels/oasis_kernels/divide/by.py": "by = 2\n",
        "kernels/oasis_kernels/divide/by.cpp": "int by;",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    packages = {name: tmp_path / path.relative_to(age.TOP) for name, path in age.PACKAGES.items()}
    monkeypatch.setattr(age, "TOP", tmp_path)
    monkeypatch.setattr(age, "PACKAGES", packages)
    return tmp_path


def digest(change=None):
    if change:
        path, text = change
        path.write_text(text)
    for cached in (age.parsed, age.imported, age.file_digest, age.code_digest):
        cached.cache_clear()
    return age.code_digest("count")


def test_a_digest_is_of_the_code_that_a_study_runs(repository):
    before, source = digest(), repository / "src" / "oasis_warp"
    text = (source / "halves.py").read_text()
    same = digest((source / "halves.py", text.replace("Half.", "A half.").replace("    from", "    # why\n    from")))
    assert same == digest((source / "other.py", "third = 4\n")) == before
    changed = digest((source / "halves.py", text + "    return x / by\n"))
    assert changed != before
    assert digest((repository / "kernels/oasis_kernels/divide/by.cpp", "long by;")) not in (before, changed)


def test_tables_say_when_their_code_has_changed(repository, monkeypatch):
    out, docs, results, before = repository / "out", repository / "docs", repository / "results", digest()
    study = type("Study", (), {"SECTIONS": (Section("page.md", "a", table((Column("value", "value"),))),)})
    monkeypatch.setattr(importlib, "import_module", lambda name: study)
    docs.mkdir()
    page = docs / "page.md"
    page.write_text("<!-- a -->\n| old |\n<!-- end of a -->\n")

    def measure():
        with age.noting_code(out, "count", (f"count/{ROWS}",)):
            write_rows(out / "count", [{"value": 1, "commit": "0123456789"}])

    def check():
        return command.note_ages(["count"], docs, results, write=False)

    assert age.noted_page("<!-- b -->\n<!-- end of b -->\n", "b", "*Measured long ago.*").count("\n") == 2
    assert check() == ["page.md: a"]
    command.render(["count"], out, docs, results)
    assert "*Measured with an older version, whose results were not kept.*\n<!-- end" in page.read_text()
    assert check() == []
    measure()
    command.render(["count"], out, docs, results)
    assert "Measured" not in page.read_text() and check() == []
    digest((repository / "studies" / "count.py", "value = 2\n"))
    assert check() == ["page.md: a"]
    command.note_ages(["count"], docs, results, write=True)
    assert page.read_text().count("*Measured at 0123456789; the code has changed since.*\n<!-- end of a -->") == 1
    assert check() == []
    measure()  # continues rows of the earlier code
    assert age.read_kept(out, "count")[f"count/{ROWS}"].code == tuple(sorted((before, digest())))
    (out / "count" / ROWS).unlink()
    measure()
    command.render(["count"], out, docs, results)
    assert "Measured" not in page.read_text()
