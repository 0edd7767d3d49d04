"""What the pages say can be done: links lead somewhere, commands are taken, and the tour works word for word."""

import ast
import importlib
import re
import shlex
import shutil
from importlib import resources
from pathlib import Path
from types import SimpleNamespace

import pytest

from oasis_warp.assets import asset
from oasis_warp.cli import app

TOP = Path(__file__).parents[1]
PAGES = [*sorted((TOP / "docs").glob("*.md")), TOP / "README.md", TOP / "CONTRIBUTING.md"]
NAMES = [page.name for page in PAGES]


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def commands(page):
    lines = "".join(blocks(page, "sh")).replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def anchors(page):
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("https://", "http://")):
            continue
        name, _, anchor = target.partition("#")
        other = page.parent / name if name else page
        assert other.exists(), target
        assert not anchor or anchor in anchors(other), target


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_are_taken(page, monkeypatch):
    taken = []
    command = SimpleNamespace(run=lambda options: taken.append(options) or 0)
    monkeypatch.setattr(app.importlib, "import_module", lambda name: command)
    given = [words[1:] for words in commands(page) if words[0] == "oasis" and "..." not in words]
    assert all(app.main(words) == 0 for words in given)
    assert len(taken) == len([words for words in given if words != ["--version"]])


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_what_python_blocks_import_is_there(page):
    for block in blocks(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("oasis_warp"):
                module = importlib.import_module(node.module or "")
                assert [alias.name for alias in node.names if not hasattr(module, alias.name)] == []


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_tour_works_word_for_word(tmp_path, monkeypatch):
    with resources.as_file(asset("photos", "palm_open_left_02.png")) as photo:
        shutil.copy(photo, tmp_path / "photo.png")
    photos = TOP / "tests" / "data" / "photos" / "same_hand" / "a1_wood_right"
    for name, photo in {"palm": "02_flat_closed", "back": "03_flat_closed_back"}.items():
        shutil.copy(photos / f"{photo}.jpg", tmp_path / f"{name}.jpg")
    page = TOP / "docs" / "tour.md"
    monkeypatch.chdir(tmp_path)
    for words in commands(page):
        assert words[0] == "oasis" and app.main(words[1:]) == 0
    for block in blocks(page, "python"):
        exec(block, {})
    made = {path.name for path in tmp_path.iterdir()} | {path.name for path in (tmp_path / "out").iterdir()}
    told = set(re.findall(r"^\| `([\w.]+)` \|", page.read_text(), re.MULTILINE))
    assert told <= made and {"fist.png", "studio.png", "clip.gif", "hand.html", "hand.glb", "hand.spz", "both"} <= made
