"""What the documents say can be done, can: commands parse, links and paths lead somewhere, code runs."""

import dataclasses
import importlib.util
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from tests.tlq.policies import trained
from tlq import cli, config

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
README = (ROOT / "README.md").read_text()

COMMAND = re.compile(r"python (train\.py|-m (?:tlq|benchmarks)\.\w+)((?: +[\w.]+=[^\s`|]+)*)")
SETTING = re.compile(r"`((?:env|policy|ppo)(?:\.\w+)+)=([^`\s]*)`")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PLACE = re.compile(
    r"`((?:tlq|envs|tg|rewards|terrains|tests|docs|notebooks|policies|benchmarks|\.ci)/[\w./-]*)`"
)


def everywhere(pattern):
    """Matches in all documents, each once, as (document and text, groups)."""
    found = {m.groups(): f"{d.name}: {m[0]}" for d in DOCUMENTS for m in pattern.finditer(d.read_text())}
    return [pytest.param(*groups, id=name) for groups, name in found.items()]


def train_arguments(arguments):
    """Composes a training configuration as train.py does; a run to resume needn't exist here."""
    from hydra import compose, initialize_config_dir

    config.register()
    arguments = config.clean([a for a in arguments if not a.startswith("resume=")])
    with initialize_config_dir(str(ROOT / "tlq" / "conf"), version_base=None):
        config.from_hydra(compose("train", overrides=arguments), arguments)


def filled_in(options, argument):
    """NAME and the like stand for one of the choices."""
    key, _, value = argument.partition("=")
    choices = {field.name: field.metadata["choices"] for field in dataclasses.fields(options)}.get(key)
    return f"{key}={choices()[0]}" if choices and value.isupper() else argument


@pytest.mark.parametrize(("program", "arguments"), everywhere(COMMAND))
def test_commands_have_settings_that_exist(program, arguments):
    arguments = shlex.split(arguments)
    if program == "train.py":
        train_arguments(arguments)
    elif program.startswith("-m benchmarks."):
        assert importlib.util.find_spec(program.split()[1])
    else:
        module = importlib.import_module(program.split()[1])
        cli.parse(module.Options, [filled_in(module.Options, argument) for argument in arguments])


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
    assert lines[1] == f"{install}'.[dev]' && .venv/bin/python -m pytest -m 'not slow'"


def test_extras_and_versions_are_those_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for document in DOCUMENTS:
        for extra in re.findall(r"'\.\[(\w+)\]'", document.read_text()):
            assert extra in project["optional-dependencies"], f"{document.name}: {extra}"
    oldest = project["requires-python"].removeprefix(">=")
    assert f"Python {oldest} or newer" in README
    assert f"## {project['version']}" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.slow
def test_readme_code_runs(tmp_path, monkeypatch):
    trained().export(tmp_path / "policy.npz")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
