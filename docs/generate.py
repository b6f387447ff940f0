"""What the site takes from the code: tables of settings and of command lines, docstrings, and formulas as MathML.

A Sphinx extension with two directives for Markdown pages: `settings` (a dataclass and those nested in it) and `options`
(the command line of a module).
"""

import dataclasses
import importlib
import re
from collections.abc import Sequence
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from tlq import cli

logger = logging.getLogger(__name__)

Row = tuple[str, ...]


def table(head: Row, rows: Sequence[Row]) -> str:
    """A Markdown table."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


# -- Settings --------------------------------------------------------------------------------------------------------


def described(cls: Any) -> dict[str, str]:
    """The docstring under each field of a dataclass, in one line."""
    docs = ModuleAnalyzer.for_module(cls.__module__).find_attr_docs()
    return {field.name: " ".join(docs[cls.__name__, field.name]).strip() for field in dataclasses.fields(cls)}


def settings(config: Any, limits: dict[str, tuple[float, float]], prefix: str = "") -> str:
    """A section for a configuration and one for each that is nested in it: docstring, and a table of the others."""
    docs, rows, nested = described(type(config)), [], []
    for name, text in docs.items():
        value, key = getattr(config, name), f"{prefix}{name}"
        if dataclasses.is_dataclass(value):
            nested.append(settings(value, limits, f"{key}."))
        else:
            rows.append((f"`{key}`", f"`{shown(value)}`", span(limits.get(key)), text))
    title = f"## {prefix.rstrip('.') or 'The run'}"
    head = ("setting", "default", "from, to", "meaning")
    return "\n\n".join([title, type(config).__doc__ or "", table(head, rows), *nested])


def shown(value: Any) -> str:
    """A default as it is written on a command line."""
    if isinstance(value, tuple):
        return "[" + ",".join(map(shown, value)) + "]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return str(value) if value != "" else '""'


def span(limits: tuple[float, float] | None) -> str:
    """Limits, both included."""
    return "" if limits is None else f"{limits[0]:g}, {limits[1]:g}"


# -- Command lines ---------------------------------------------------------------------------------------------------


def options(module: str) -> str:
    """A module's docstring, and a table of its `Options`."""
    found = importlib.import_module(module)
    rows = []
    for field in cli.settings(found.Options):
        choices = field.metadata["choices"]
        text = field.metadata["text"] + (f"; one of {', '.join(choices())}" if choices else "")
        default = "required" if field.metadata["required"] else f"`{shown(field.default)}`"
        rows.append((f"`{field.name}=`", default, text))
    return "\n\n".join([(found.__doc__ or "").strip(), table(("option", "default", "meaning"), rows)])


# -- Sphinx ----------------------------------------------------------------------------------------------------------


class Settings(SphinxDirective):
    """All settings of train.py."""

    def run(self) -> list[nodes.Node]:
        """The sections, in place of the directive."""
        from envs.limits import LIMITS as ENVIRONMENT
        from tlq.config import LIMITS, default_config

        limits = LIMITS | {f"env.{name}": span for name, span in ENVIRONMENT.items()}
        return self.parse_text_to_nodes(settings(default_config(), limits), allow_section_headings=True)


class Options(SphinxDirective):
    """The command line of a module."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Text and table, in place of the directive."""
        return self.parse_text_to_nodes(options(self.arguments[0]))


def visit_math(translator: Any, node: nodes.Element, block: bool = False) -> None:
    """A formula as MathML, by docutils' own converter, which Sphinx has no switch for."""
    try:
        translator.body.append(tex2mathml(node.astext(), as_block=block))
    except MathError as error:
        logger.warning("%s in %s", error, node.astext(), location=node)
    raise nodes.SkipNode


def visit_math_block(translator: Any, node: nodes.Element) -> None:
    """A formula on a line of its own."""
    visit_math(translator, node, block=True)


def restructure(lines: list[str]) -> list[str]:
    """A docstring as reStructuredText: nothing but `names`, "Args:" and the like, and indented code means anything."""
    text: list[str] = []
    inside = code = False
    for line in lines:
        item = re.match(r"  ([\w, *]+): (.*)", line)
        if line in ("Args:", "Returns:", "Yields:"):
            inside = True
            text += ["", f"*{line}*", ""]
        elif inside and item:
            text += ["", f"- `{item[1]}`: {escape(item[2])}"]
        elif inside:
            text.append(escape(line[2:]))
        elif line.startswith("    "):
            text += [line] if code else ["::", "", line]
            code = True
        else:
            code = code and not line
            text.append(escape(line))
    return text


def escape(text: str) -> str:
    """What would be markup outside of `names`, made plain."""
    parts = text.split("`")
    parts[::2] = [re.sub(r"([|*])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)


def process(app: Sphinx, what: str, name: str, obj: Any, opts: Any, lines: list[str]) -> None:
    """Autodoc's hook."""
    lines[:] = restructure(lines)


def setup(app: Sphinx) -> dict[str, Any]:
    """Registers the above."""
    app.add_directive("settings", Settings)
    app.add_directive("options", Options)
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    app.connect("autodoc-process-docstring", process)
    return {"parallel_read_safe": True}
