"""The documents: what stands in them, their commands parsed as the programs do, their Python run."""

import dataclasses
import importlib
import re
import shlex
import sys
from pathlib import Path

from tlq import cli, config

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "benchmarks" / "README.md"])

ARGUMENTS = r"((?: +[\w.]+=[^\s`|]+)*)"
COMMAND = re.compile(rf"python (train\.py|-m (?:tlq|benchmarks|docs)\.\w+){ARGUMENTS}")
OWN = re.compile(rf"python (\w+)\.py (train|evaluate|play){ARGUMENTS}")
"""A program that a page makes, which starts one of ours."""


def blocks(document):
    """A document's Python, in order."""
    return re.findall(r"```python\n(.*?)```", document.read_text(), flags=re.DOTALL)


def runs(block):
    """Whether a block can run as it stands, with nothing of the reader's."""
    return "# your code" not in block


def parse(program, arguments):
    """Reads a command line as its program does, without running it."""
    arguments = shlex.split(arguments)
    if program == "train.py":
        train_arguments(arguments)
        return
    module = importlib.import_module(program.split()[1])
    if hasattr(module, "Options"):
        cli.parse(module.Options, [filled_in(module.Options, argument) for argument in arguments])
    else:
        assert not arguments


def train_arguments(arguments):
    """Composes a training configuration as train.py does; a run to resume needn't exist here."""
    from hydra import compose, initialize_config_dir

    config.register()
    arguments = config.clean([a for a in arguments if not a.startswith("resume=")])
    with initialize_config_dir(str(ROOT / "tlq" / "conf"), version_base=None):
        config.from_hydra(compose("train", overrides=arguments), arguments)


def filled_in(options, argument):
    """NAME and the like stand for one of the choices, or for a number."""
    key, _, value = argument.partition("=")
    field = {field.name: field for field in dataclasses.fields(options)}.get(key)
    if field is None or not value.isupper():
        return argument
    if field.metadata["choices"]:
        return f"{key}={field.metadata['choices']()[0]}"
    return argument if isinstance(field.default, str) else f"{key}={field.default}"


def run(document):
    """Runs a document's Python in one namespace, in this folder.

    A block that begins with a file's name is written to it, one that calls for "your code" can't run. Then come the
    commands of programs that the page has made.
    """
    names = {}
    for block in blocks(document):
        code = compile(block, document.name, "exec")
        file = re.match(r"# (\w+\.py)\n", block)
        if file:
            Path(file[1]).write_text(block)
        elif runs(block):
            exec(code, names)
    for own, program, arguments in OWN.findall(document.read_text()):
        importlib.import_module(own)
        parse("train.py" if program == "train" else f"-m tlq.{program}", arguments)


if __name__ == "__main__":
    run(Path(sys.argv[1]))
