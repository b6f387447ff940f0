"""What the documents say can be done, can: commands parse, links and paths lead somewhere, code runs."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib

import pytest

from tests.pages import COMMAND, DOCUMENTS, OWN, ROOT, blocks, parse, runs, train_arguments

README = (ROOT / "README.md").read_text()
WITH_CODE = [document for document in DOCUMENTS if blocks(document)]

SETTING = re.compile(r"`((?:env|policy|ppo)(?:\.\w+)+)=([^`\s]*)`")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PLACE = re.compile(
    r"`((?:tlq|envs|tg|rewards|terrains|tests|docs|notebooks|policies|benchmarks|\.ci)/[\w./-]*)`"
)


def everywhere(pattern):
    """Matches in all documents, each once, as (document and text, groups)."""
    found = {m.groups(): f"{d.name}: {m[0]}" for d in DOCUMENTS for m in pattern.finditer(d.read_text())}
    return [pytest.param(*groups, id=name) for groups, name in found.items()]


@pytest.mark.parametrize(("program", "arguments"), everywhere(COMMAND))
def test_commands_have_settings_that_exist(program, arguments):
    parse(program, arguments)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_lines_that_start_a_program_are_checked(document):
    """A command that the pattern above doesn't see wouldn't be."""
    lines = re.findall(r"^ {4}(?:\w+ )?(python .*)", document.read_text(), flags=re.MULTILINE)
    known = (COMMAND, OWN, re.compile(r"python -m pytest"))
    assert [line for line in lines if not any(pattern.match(line) for pattern in known)] == []


@pytest.mark.parametrize(("key", "value"), everywhere(SETTING))
def test_settings_exist(key, value):
    train_arguments([f"{key}={value}"])


def anchors(text):
    """Names of a document's headings in links, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document):
    for target in LINK.findall(document.read_text()):
        if target.startswith(("https://", "http://")):
            continue
        path, _, anchor = target.partition("#")
        place = document.parent / path if path else document
        assert place.exists(), f"{document.name} links to {target}"
        assert not anchor or anchor in anchors(place.read_text()), f"{document.name} links to {target}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_places_exist(document):
    missing = [place for place in PLACE.findall(document.read_text()) if not (ROOT / place).exists()]
    assert not missing


def test_readme_begins_with_two_commands_of_a_line_each():
    """`.ci/run` reads them here."""
    lines = [line.strip() for line in README.splitlines() if line.startswith("    ")]
    install = "python3 -m venv .venv && .venv/bin/pip install -e "
    assert lines[0] == f"{install}. && .venv/bin/python train.py terrain=poles"
    assert lines[1] == f"{install}'.[dev]' && .venv/bin/python -m pytest -n 2 --dist loadfile -m 'not slow'"


def test_extras_and_versions_are_those_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for document in DOCUMENTS:
        for extra in re.findall(r"'\.\[(\w+)\]'", document.read_text()):
            assert extra in project["optional-dependencies"], f"{document.name}: {extra}"
    oldest = project["requires-python"].removeprefix(">=")
    assert f"Python {oldest} or newer" in README
    assert f"## {project['version']}" in (ROOT / "CHANGELOG.md").read_text()


def walks(document):
    """Whether a document's code compiles an environment's step, which takes a minute."""
    return any(".step)" in block for block in blocks(document))


@pytest.mark.parametrize("document", WITH_CODE, ids=lambda path: path.name)
def test_code_is_python(document):
    for block in blocks(document):
        ast.parse(block)


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(document, id=document.name, marks=[pytest.mark.slow] if walks(document) else [])
        for document in WITH_CODE
        if any(map(runs, blocks(document)))
    ],
)
def test_code_runs(document, tmp_path, request):
    """In a process of its own: pages register robots and terrains."""
    shutil.copy(ROOT / "policies" / "blocks.npz", tmp_path / "policy.npz")
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(request.config.cache.mkdir("jax")))
    done = subprocess.run(
        [sys.executable, "-m", "tests.pages", str(document)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": cache},
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode == 0, done.stderr
