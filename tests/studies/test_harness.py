"""Studies go on where they stopped, and fill the pages that they say; pages say which code has measured them."""

import importlib
import json
import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from synthetic import crop_of

from oasis_warp.avatar.observation import batch_of_crop
from oasis_warp.core.errors import InputError
from oasis_warp.evaluation.methods import METHODS
from oasis_warp.evaluation.summary import HIDDEN, SYNTHETIC, summarise
from oasis_warp.network.config import COMPACT
from oasis_warp.network.hand_network import HandNetwork
from oasis_warp.network.weights_file import load_network, save_network
from studies import __main__ as command
from studies import age, evaluation, tables
from studies.harness import ROWS, StudyOptions, measured, read_rows, write_rows
from studies.prior_card import file_table, gaussian_table, training_text
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
        return {**dict.fromkeys((*SYNTHETIC, *HIDDEN), 0.5), **about, **method._asdict(), "lpips": None,
                "psnr_squeezed": None, "psnr": psnr}  # fmt: skip

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
    assert age.read_measured(out, "count")[f"count/{ROWS}"].code == tuple(sorted((before, digest())))
    (out / "count" / ROWS).unlink()
    measure()
    command.render(["count"], out, docs, results)
    assert "Measured" not in page.read_text()


def test_a_table_is_as_old_as_its_own_file(repository, monkeypatch):
    """Files that are too large to keep count too; one that is old made all tables of its study look old."""
    docs, results = repository / "docs", repository / "results"
    sections = tuple(Section("page.md", name, table((Column("value", "value"),)), f"{name}.json") for name in "ab")
    monkeypatch.setattr(importlib, "import_module", lambda name: type("Study", (), {"SECTIONS": sections}))
    docs.mkdir()
    results.mkdir()
    (docs / "page.md").write_text("<!-- a -->\n| 1 |\n<!-- end of a -->\n<!-- b -->\n| 2 |\n<!-- end of b -->\n")
    fresh, old = age.MeasuredCode((digest(),), "0123456789"), age.MeasuredCode(("old",), "abcdef0123")
    age.write_measured(results, "count", {"a.json": fresh, "b.json": old})
    assert command.note_ages(["count"], docs, results, write=True) == ["page.md: b"]
    page = (docs / "page.md").read_text()
    assert page.count("Measured") == 1
    assert "*Measured at abcdef0123; the code has changed since.*\n<!-- end of b" in page


NOTES = {
    "step": 1234, "steps": 2000, "hands": 16, "people": 512, "seed": 3, "precision": "bfloat16", "profile": "compact",
    "hold_out": ["tattoo", "ring"], "losses": {"rgb": 10.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def weights(hand, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "network.safetensors"
    small = replace(COMPACT, image_size=32, width=32, heads=2, n_tokens=16, n_coarse=64, refine_layers=1, head_width=16)
    save_network(path, HandNetwork(small, hand), notes=json.dumps(NOTES))
    return path


def test_the_file_and_its_training_are_told_from_its_header(weights):
    text = file_table(weights)
    assert "12,337 vertices, 24,608 faces" in text and "32 channels, 16 tokens" in text
    trained = training_text(weights)
    assert "| step | 1,234 |" in trained and "| losses | rgb 10.0 |" in trained
    command = "oasis pretrain prior --steps 2000 --hands 16 --people 512 --seed 3 --precision bf16 --profile compact"
    assert f"{command} --hold-out tattoo ring\n" in trained


def test_the_command_that_retrains_is_one_that_the_command_line_takes(weights):
    import tyro

    from oasis_warp.cli.developer_options import Pretrain

    line = next(line for line in training_text(weights).splitlines() if line.startswith("oasis pretrain"))
    options = tyro.cli(Pretrain, args=line.split()[2:])
    assert (options.steps, options.seed, options.precision) == (2000, 3, "bf16")
    assert options.hold_out == ("tattoo", "ring")


def test_an_untrained_prior_has_the_gaussians_of_the_mean_hand(weights, hand):
    crop, _, _ = crop_of(hand, torch.full_like(hand.template, 0.5), size=32)
    lines = gaussian_table(load_network(weights, hand).eval(), [batch_of_crop(crop)]).splitlines()
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in lines}
    assert [float(cell) for cell in rows["on vertices: opacity"]] == [0.95] * 3
    assert [float(cell) for cell in rows["on vertices: under the skin, mm"]] == [0.8] * 3
    assert [float(cell) for cell in rows["on faces: from the middle of the face, mm"]] == [0.0] * 3
    assert [float(cell) for cell in rows["on faces: largest share of a corner in a face's features"]] == [0.33] * 3
    low, middle, high = (float(cell) for cell in rows["on faces: largest deviation, mm"])
    assert 0.1 < low < middle < high < 2


def test_priors_are_compared_where_they_differ_most():
    """A pair without a measure, or a gain counted with the wrong sign, would make the share wrong."""
    pairs = []
    for k in range(8):  # on pairs 6 and 7 the two differ most; learned wins one of them by PSNR, both by colours
        gain = {6: -3.0, 7: 4.0}.get(k, 0.1)
        same = {"hand": "a", "source": str(k), "target": "t", "stage": "one_shot", "ssim_quarter": 0.5}
        pairs.append({**same, "prior": "mean", "psnr": 20.0, "error": 0.1})
        pairs.append({**same, "prior": "learned", "psnr": 20 + gain, "error": 0.1 - abs(gain) / 100})
        pairs.append({**same, "prior": "learned", "stage": "raw", "psnr": 30.0, "error": 0.0})
    del pairs[0]["error"], pairs[1]["error"]
    said = evaluation.where_priors_differ(pairs)
    assert said.endswith("learned is better on 50% by PSNR, 0% by SSIM, 100% by colours.")
