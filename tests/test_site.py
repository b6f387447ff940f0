"""The site builds without a warning, needs nothing from elsewhere, and shows every setting, option and public name."""

import ast
import dataclasses
import html
import importlib
import re
import shutil
import subprocess
import sys

import pytest

from docs import pictures
from envs.limits import leaves
from tests.pages import DOCUMENTS, ROOT
from tlq.config import default_config

ROOMS = ("envs", "rewards", "terrains", "tg")


def build(source, target):
    """Runs Sphinx as CONTRIBUTING says, into another folder."""
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-E",
        "-W",
        "--keep-going",
        "-c",
        "docs",
        ".",
        str(target),
    ]
    return subprocess.run(command, cwd=source, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    target = tmp_path_factory.mktemp("site")
    done = build(ROOT, target)
    assert done.returncode == 0, done.stderr
    return target


def test_contributing_tells_how_to_build_it():
    assert "sphinx-build -E -W -c docs . build/site" in (ROOT / "CONTRIBUTING.md").read_text()


def test_every_document_is_a_page(site):
    missing = [d.name for d in DOCUMENTS if not (site / d.relative_to(ROOT)).with_suffix(".html").exists()]
    assert missing == []


def test_pages_load_nothing_from_elsewhere(site):
    for page in site.rglob("*.html"):
        loaded = re.findall(r"<(?:script|img|link|iframe)\b[^>]*?(?:src|href)=\"([^\"]*)", page.read_text())
        assert [place for place in loaded if "//" in place] == [], page.name
    for sheet in site.rglob("*.css"):
        assert not re.search(r"url\([^)]*//|@import", sheet.read_text()), sheet.name


def test_formulas_are_shown_without_a_script(site):
    page = (site / "docs" / "equations.html").read_text()
    assert page.count("<math") > 20 and "$" not in re.sub(r"<[^>]*>", "", page)


def text(page):
    """A page without its markup."""
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text()))


def test_every_setting_is_on_the_page_with_its_meaning(site):
    page = (site / "docs" / "settings.html").read_text()
    rows = [re.findall(r"<td><p>(.*?)</p></td>", row, flags=re.DOTALL) for row in page.split("<tr ")]
    shown = {re.sub("<[^>]+>", "", row[0]): row[-1] for row in rows if row}
    assert set(shown) == {name for name, _ in leaves(default_config())}
    assert [name for name, meaning in shown.items() if len(meaning) < 3] == []


def test_every_option_is_on_the_page(site):
    page = text(site / "docs" / "commands.html")
    for path in (ROOT / "tlq").glob("*.py"):
        if any(
            isinstance(node, ast.ClassDef) and node.name == "Options"
            for node in ast.parse(path.read_text()).body
        ):
            module = importlib.import_module(f"tlq.{path.stem}")
            assert f"tlq.{path.stem}" in page
            for field in dataclasses.fields(module.Options):
                assert f"{field.name}=" in page and field.metadata["text"] in page, (
                    f"{path.stem}: {field.name}"
                )


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_name_is_on_the_page(site, room):
    """Constants and submodules are described where they are defined."""
    module = importlib.import_module(room)
    page = (site / "docs" / "api.html").read_text()
    names = [n for n in module.__all__ if callable(getattr(module, n))]
    assert [name for name in names if f'id="{room}.{name}"' not in page] == []


@pytest.mark.parametrize(
    "mistake", ["[there](nowhere.md)", "[there](#nowhere)", "![it](nowhere.png)", r"$\nonsense$"]
)
def test_a_mistake_fails_the_build(tmp_path, mistake):
    (tmp_path / "docs").mkdir()
    for name in ("conf.py", "generate.py"):
        shutil.copy(ROOT / "docs" / name, tmp_path / "docs")
    (tmp_path / "docs" / "index.md").write_text(f"# Title\n\n{mistake}\n")
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode == 1 and re.search("nowhere|nonsense", done.stderr)


def test_pictures_are_drawn_and_used(tmp_path):
    pictures.main([f"folder={tmp_path}"])
    pages = "".join(document.read_text() for document in DOCUMENTS)
    for name in pictures.PICTURES:
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
        assert (ROOT / "docs" / "images" / f"{name}.png").exists() and f"images/{name}.png" in pages
