"""Studies go on where they stopped, and fill the pages that they say they fill."""

import importlib
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import pytest

from oasis_warp.core.errors import InputError
from oasis_warp.evaluation.columns import SYNTHETIC
from oasis_warp.evaluation.methods import METHODS
from oasis_warp.evaluation.summary import summarise
from studies import __main__ as command
from studies import evaluation, tables
from studies.harness import ROWS, StudyOptions, measured, read_rows, write_rows
from studies.seeded_bugs import BUGS
from studies.tables import Column, Section, fill, markdown, medians, power, short, table

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
NAMES = sorted(command.studies())


@dataclass(frozen=True, kw_only=True)
class Counted(StudyOptions):
    selecting: ClassVar[frozenset[str]] = frozenset({"people"})
    people: int = 2
    size: int = 256


def square(number, size):
    if number == 3:
        raise InputError("3: found no hand.")
    return {"number": number, "square": number**2, "size": size}


def cases(options):
    return {f"person {k}": (k, options.size) for k in range(options.people)}


@pytest.mark.parametrize("name", NAMES)
def test_every_study_can_be_run_and_fills_sections_that_its_pages_have(name):
    study = importlib.import_module(f"studies.{name}")
    assert issubclass(study.Options, StudyOptions) and callable(study.run)
    study.Options().settings()
    for section in study.SECTIONS:
        if section.page:
            page = (DOCS / section.page).read_text()
            assert fill(page, section.marker, "new").count("\nnew\n") == 1, section.marker


def test_every_section_of_a_page_is_filled_by_one_study():
    filled = [
        (section.page, section.marker)
        for name in NAMES for section in importlib.import_module(f"studies.{name}").SECTIONS if section.page
    ]  # fmt: skip
    assert len(filled) == len(set(filled))
    marked = [
        (page.name, marker) for page in DOCS.glob("*.md")
        for marker in re.findall(r"<!-- (?!end of)(.+?)(?: \([^)]*\))? -->", page.read_text())
    ]  # fmt: skip
    assert set(marked) == set(filled)


def test_every_seeded_bug_still_has_its_place_and_its_tests():
    assert [bug.name for bug in BUGS if (ROOT / bug.path).read_text().count(bug.old) != 1] == []
    assert [bug.name for bug in BUGS if not (ROOT / bug.tests[0]).is_file()] == []


def test_studies_are_listed_with_a_line_each(capsys):
    assert command.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == NAMES and all(line.endswith(".") for line in lines)
    with pytest.raises(SystemExit, match="expected list, render, age or the name of a study, got fitt"):
        command.main(["fitt"])


def test_a_study_that_was_stopped_goes_on_with_the_missing_cases(tmp_path):
    met = []

    def measure(number, size):
        met.append(number)
        if number == 2 and met.count(2) == 1:
            raise KeyboardInterrupt
        return square(number, size)

    options = Counted(out=tmp_path, people=4)
    with pytest.raises(KeyboardInterrupt):
        measured("counted", cases(options), measure, options)
    with (tmp_path / "counted" / ROWS).open("a") as file:
        file.write('{"case": "person 2", "num')  # as a process that is killed leaves it
    rows = measured("counted", cases(options), measure, options)
    assert met == [0, 1, 2, 2, 3]
    assert [row.get("square") for row in rows] == [0, 1, 4, None]
    assert rows[3]["refused"] == "3: found no hand." and all("commit" in row for row in rows)
    assert read_rows(tmp_path / "counted" / ROWS) == rows
    fewer = measured("counted", cases(replace(options, people=1)), measure, replace(options, people=1))
    assert fewer == rows[:1] and len(met) == 5


def test_results_with_other_settings_are_not_mixed(tmp_path):
    options = Counted(out=tmp_path, people=1)
    measured("counted", cases(options), square, options)
    with pytest.raises(InputError, match="made with other settings, size 256 and not 64"):
        measured("counted", cases(options), square, replace(options, size=64))


@pytest.mark.slow
def test_cases_measured_by_other_processes_are_the_same(tmp_path):
    options = Counted(out=tmp_path / "two", people=4, workers=2)
    there = measured("counted", cases(options), square, options)
    here = measured("counted", cases(options), square, replace(options, out=tmp_path / "none", workers=0))
    assert sorted(there, key=lambda row: row["case"]) == here


def test_a_table_has_units_medians_and_no_refused_rows():
    columns = Column("photo", "case"), Column("PSNR, dB", "psnr", ".1f"), Column("", lambda row: row["words"])
    rows = [
        {"case": "a", "psnr": 20.04, "words": "dark"}, {"case": "b", "psnr": 30, "words": None},
        {"case": "c", "refused": "no"},
    ]  # fmt: skip
    text = table(columns[:2], foot=medians, after=lambda rows: f"{len(rows)} photos.")(rows)
    lines = ["| photo | PSNR, dB |", "| --- | --- |", "| a | 20.0 |", "| b | 30.0 |", "| **median** | 25.0 |"]
    assert text == "\n".join([*lines, "", "3 photos."])
    assert "| b | 30.0 |  |" in (table(columns)(rows) or "")
    assert table(columns)(rows[2:]) is None


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, ""), (0.123456, "0.123"), (12_345.6, "12,346"), (99.96, "100"), (1e-5, "1e-05"), (0.0, "0")],
)
def test_numbers_are_written_short(value, text):
    assert short(value) == text


@pytest.mark.parametrize(("value", "text"), [(None, ""), (0.0, "0"), (3.4e-7, "3e-7"), (1.2, "1"), (2e-12, "2e-12")])
def test_errors_are_written_as_powers_of_ten(value, text):
    assert power(value) == text


def test_a_section_is_replaced_and_the_prose_stays():
    page = "".join(f"prose {k}\n<!-- {k} -->\nold\n<!-- end of {k} -->\n" for k in ("one", "two"))
    once = fill(page, "one", r"new \1")
    assert once == page.replace("<!-- one -->\nold", "<!-- one -->\nnew \\1")
    marked = fill(once, "one", "newer", commit="0123456789")
    assert "<!-- one (0123456789) -->\nnewer\n<!-- end of one -->" in marked
    assert fill(marked, "one", r"new \1") == once
    with pytest.raises(SystemExit, match="expected <!-- one --> and <!-- end of one --> in the page"):
        fill("no markers", "one", "text")


def test_pages_name_the_commit_and_keep_what_has_no_rows(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- a -->\n<!-- end of a -->\n<!-- b -->\nold\n<!-- end of b -->\n")
    rows = write_rows(tmp_path / "study", [{"value": 1}, {"value": 2}])
    sections = (
        Section("page.md", "a", table((Column("value", "value"),))), Section("page.md", "b", lambda rows: None),
        Section(None, "c", lambda rows: "only printed"),
    )  # fmt: skip
    rows = [{**row, "commit": "0123456789"} for row in rows]
    assert tables.render(sections, rows, tmp_path) == ["page.md: a"]
    made = markdown(["value"], [["1"], ["2"]])
    filled = f"<!-- a (0123456789) -->\n{made}\n<!-- end of a -->\n"
    assert page.read_text() == f"{filled}<!-- b -->\nold\n<!-- end of b -->\n"


def test_evaluations_fill_their_pages(tmp_path):
    def picture(method, person, psnr, light, colors, noise):
        about = {"group": "ordinary", "light": light, "noise": noise, "colors": colors, "person": person, "target": 0}
        return {**dict.fromkeys(SYNTHETIC, 0.5), **about, **method._asdict(), "lpips": None, "psnr_squeezed": None,
                "psnr": psnr}  # fmt: skip

    methods = [method for method in METHODS if method.prior == "mean"]
    records = [
        picture(method, person, 20.0 + k, light, colors, noise)
        for k, method in enumerate(methods) for person in (1, 2) for light in ("studio", "wild")
        for colors in ("raw", "matched") for noise in (0.0, 1.0, 2.0)
    ]  # fmt: skip
    settings = {
        "groups": ["ordinary"], "lights": ["studio", "wild"], "noise": [0.0, 1.0], "curve": [2.0], "people": 2,
        "capture": {"targets": 1, "size": 64}, "priors": {"mean": None}, "lpips": False,
    }  # fmt: skip
    (tmp_path / "evaluation").mkdir()
    found = {"settings": settings, "summary": summarise(records)}
    (tmp_path / "evaluation" / "metrics.json").write_text(json.dumps(found))
    for name in ("evaluation.md", "prior.md"):
        (tmp_path / name).write_text((DOCS / name).read_text())
    command.render(["evaluation"], tmp_path, tmp_path, tmp_path / "kept")
    filled = (tmp_path / "evaluation.md").read_text()
    assert "| mean one-shot | true pose | 21.00 | +1.00 | 0.00 | 100% |" in filled
    assert "| method | true pose | estimated | errors x 2 |" in filled
    assert "| mean calibrated | 20.00 | 20.00 | 20.00 |" in filled
    assert "2 people, 1 targets each, 64 px." in filled and evaluation.FOLDERS["same-hand"] in filled
    command.render(["evaluation"], tmp_path, tmp_path, tmp_path / "kept")
    assert (tmp_path / "evaluation.md").read_text() == filled
