"""Command lines of the form key=value, with one line and exit code 2 for what isn't valid.

A program's options are a class:

    @dataclasses.dataclass(frozen=True)
    class Options:
        terrain: str = option("poles", "kind of terrain", choices=kinds)
        episodes: int = option(18, "episodes to run")

    options = parse(Options, sys.argv[1:], __doc__)
"""

import dataclasses
import difflib
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

POLICIES = Path(__file__).resolve().parents[1] / "policies"
"""Policies that come with tlq; `index.json` there gives each name a file: {"poles": {"file": "poles.npz"}}."""


class UsageError(ValueError):
    """A command line that isn't valid; the text names what is."""


def option(
    default: Any, text: str, *, choices: Callable[[], Sequence[str]] | None = None, required: bool = False
) -> Any:
    """A field of an options class; its type is that of the default, and `choices` gives the valid strings."""
    return dataclasses.field(
        default=default, metadata={"text": text, "choices": choices, "required": required}
    )


def settings(cls: Any) -> list[Any]:
    """Fields of an options class: its own, then those that it shares with other programs."""
    own = cls.__dict__.get("__annotations__", {})
    return sorted(dataclasses.fields(cls), key=lambda field: field.name not in own)


def unknown(what: str, name: str, known: Sequence[str]) -> str:
    """A message that names the valid choices, and the closest one."""
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"unknown {what} '{name}'{hint}; choose one of {', '.join(known)}"


def parse(cls: Any, arguments: Sequence[str], text: str = "") -> Any:
    """Options of a class made of `option` fields; `--help` prints them after `text` and ends the program."""
    if {"--help", "-h"} & set(arguments):
        print(_help(cls, text))
        sys.exit(0)
    fields = {field.name: field for field in settings(cls)}
    values: dict[str, Any] = {}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals:
            raise UsageError(f"'{argument}' isn't of the form key=value; choose from {', '.join(fields)}")
        if key not in fields:
            raise UsageError(unknown("setting", key, list(fields)))
        values[key] = _convert(fields[key], value)
    for name, field in fields.items():
        if field.metadata["required"] and not values.get(name):
            raise UsageError(f"{name}= is missing: {field.metadata['text']}")
    return cls(**values)


def _convert(field: Any, value: str) -> Any:
    choices = field.metadata["choices"]
    if choices is not None and value not in choices():
        raise UsageError(unknown(field.name, value, choices()))
    kind = type(field.default)
    try:
        if kind is bool:
            return {"true": True, "1": True, "false": False, "0": False}[value.lower()]
        if kind is int:
            number = float(value)  # 2e6 is a whole number too
            if number != int(number):
                raise ValueError
            return int(value) if value.lstrip("+-").isdigit() else int(number)
        return kind(value)
    except (ValueError, KeyError, OverflowError):
        wanted = {bool: "true or false", int: "a whole number", float: "a number"}[kind]
        raise UsageError(f"{field.name}={value} isn't {wanted}") from None


def _help(cls: Any, text: str) -> str:
    lines = [text.strip(), "", "settings (key=value):"]
    for field in settings(cls):
        choices = field.metadata["choices"]
        names = f"; one of {', '.join(choices())}" if choices else ""
        default = "required" if field.metadata["required"] else f"default {field.default!r}"
        lines.append(f"  {field.name:<12} {field.metadata['text']}{names} ({default})")
    return "\n".join(lines)


def find_policy(name: str) -> Path:
    """Path of a policy: a file's, a run folder's, or that of a policy that comes with tlq, by its name."""
    path = Path(name)
    if path.is_file():
        return path
    if (path / "policy.npz").is_file():
        return path / "policy.npz"
    index = POLICIES / "index.json"
    shipped = json.loads(index.read_text()) if index.is_file() else {}
    if name in shipped:
        return POLICIES / shipped[name]["file"]
    choices = f", or one of {', '.join(shipped)}" if shipped else ""
    raise UsageError(
        f"policy={name}: no such policy; choose a policy file or a run folder that holds one{choices}"
    )


def find_monitor(name: str) -> Path | None:
    """Path of a safety monitor: a file's, or that of one that comes with tlq, by its name; None for "none"."""
    if name == "none":
        return None
    path = Path(name)
    if path.is_file():
        return path
    shipped = {file.stem: file for file in sorted((POLICIES / "monitors").glob("*.npz"))}
    if name in shipped:
        return shipped[name]
    raise UsageError(
        f"monitor={name}: no such monitor; choose a monitor's file, or one of {', '.join(['none', *shipped])}"
    )


def check_folders(options: Any, *names: str) -> None:
    """Raises UsageError where the folder of a file that is to be written isn't there."""
    for name in names:
        value = getattr(options, name)
        folder = Path(value).absolute().parent
        if value and not folder.is_dir():
            raise UsageError(f"{name}={value}: there is no folder {folder}")


def one_line(error: BaseException) -> str:
    """What an error says, without line breaks."""
    return " ".join(str(error).split())


def run(main: Callable[[Sequence[str]], None], arguments: Sequence[str] | None = None) -> None:
    """Calls `main` with the command line; an error of the user's is one line and exit code 2."""
    try:
        main(sys.argv[1:] if arguments is None else arguments)
    except (ValueError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        stopped()


def stopped() -> NoReturn:
    """One line and exit code 130, for a program that was interrupted."""
    print("stopped", file=sys.stderr, flush=True)
    sys.exit(130)


def fail(error: Exception, *, at_once: bool = False) -> NoReturn:
    """One line and exit code 2; at_once: without waiting for threads that may still want to write to a full disk."""
    print(f"error: {one_line(error)}", file=sys.stderr, flush=True)
    if at_once:
        sys.stdout.flush()
        os._exit(2)
    sys.exit(2)
