"""From words to a verb: tyro's dataclass parser, with errors of one line and nearest names."""

import contextlib
import dataclasses
import inspect
import io
import os
import re
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Protocol, Union

import tyro

from odomap.cli.bundle import Bundle
from odomap.cli.calibrate import Calibrate
from odomap.cli.config import ConfigVerb
from odomap.cli.demo import Demo
from odomap.cli.doctor import Doctor
from odomap.cli.evaluate import Evaluate
from odomap.cli.export import Export
from odomap.cli.info import Info
from odomap.cli.localize import Continue, Localize
from odomap.cli.loops import Loops
from odomap.cli.merge import Merge
from odomap.cli.optimize import Optimize
from odomap.cli.register import Register
from odomap.cli.run import Run
from odomap.cli.view import ViewVerb
from odomap.cli.vocabulary import VocabularyVerb
from odomap.errors import InputError, nearest_name
from odomap.version import __version__

__all__ = ["Verb", "parse"]

VERBS: dict[str, Any] = {
    "run": Run,
    "localize": Localize,
    "continue": Continue,
    "merge": Merge,
    "demo": Demo,
    "calibrate": Calibrate,
    "eval": Evaluate,
    "optimize": Optimize,
    "bundle": Bundle,
    "register": Register,
    "export": Export,
    "vocabulary": VocabularyVerb,
    "loops": Loops,
    "info": Info,
    "view": ViewVerb,
    "config": ConfigVerb,
    "doctor": Doctor,
}

TAKES_OVERRIDES = frozenset({"run", "localize", "continue", "demo", "config"})
"""Verbs that accept --section.field VALUE for any field of the config."""

DESCRIPTION = """SLAM in Python.

`odomap demo` shows it on a simulated world, `odomap run DATA` on a recording;
`odomap doctor` says whether the installation is sound."""


class Verb(Protocol):
    """What the command line does with parsed arguments."""

    def execute(self) -> int:
        """Do the work and return the exit code."""
        ...


def parse(argv: list[str]) -> Verb | int:
    """Read the command line.

    Args:
        argv: arguments without the program's name.

    Returns:
        The verb, ready to execute; or an exit code where there is nothing left to do (help).

    Raises:
        InputError: an unknown verb or option, or a value that cannot be read.
    """
    if argv[:1] in (["--version"], ["-V"]):
        print(f"odomap {__version__}")
        return 0
    if not argv:
        _tyro(["--help"])
        return 2
    if not argv[0].startswith("-") and argv[0] not in VERBS:
        near = nearest_name(argv[0], VERBS) or f": one of {', '.join(VERBS)} expected"
        raise InputError(f"unknown command '{argv[0]}'{near}")
    overrides, words = _split(argv)
    parsed = _tyro(words)
    if isinstance(parsed, int):
        return parsed
    verb, rest = parsed
    if rest:
        raise InputError(_unexpected(rest[0], argv[0]))
    if overrides and argv[0] not in TAKES_OVERRIDES:
        raise InputError(_unexpected(f"--{overrides[0][0]}", argv[0]))
    chosen: Verb = dataclasses.replace(verb, overrides=overrides) if overrides else verb
    return chosen


def _split(argv: Sequence[str]) -> tuple[tuple[tuple[str, str], ...], list[str]]:
    """Part the --section.field VALUE pairs from the words that are tyro's."""
    overrides, words = [], []
    rest = iter(argv)
    for word in rest:
        name, equals, value = word.removeprefix("--").partition("=")
        if not word.startswith("--") or "." not in name:
            words.append(word)
            continue
        following = value if equals else next(rest, None)
        if following is None:
            raise InputError(f"option '--{name}' needs a value")
        overrides.append((name.replace("-", "_"), following))
    return tuple(overrides), words


def _unexpected(word: str, verb: str) -> str:
    if not word.startswith("--"):
        return f"unexpected argument '{word}' (see odomap {verb} --help)"
    name = word[2:].partition("=")[0]
    near = nearest_name(name.replace("_", "-"), _options(verb))
    hint = near.replace("'", "'--", 1) or f" (see odomap {verb} --help)"
    return f"unknown option '--{name}'{hint}"


def _tyro(argv: list[str]) -> tuple[Any, list[str]] | int:
    """Let tyro parse; return its exit code after help, or raise its complaint as one line."""
    choices = tuple(
        Annotated[verb, tyro.conf.subcommand(name, description=_summary(name, argv))]
        for name, verb in VERBS.items()
    )
    any_verb: Any = Union[choices]  # noqa: UP007 (the tuple is made at run time)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint), _width(argv):
            parsed: tuple[Any, list[str]] = tyro.cli(
                any_verb,
                args=argv,
                prog="odomap",
                description=DESCRIPTION,
                return_unknown_args=True,
                config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
            )
            return parsed
    except SystemExit as stop:
        if stop.code in (0, None):
            return 0
        raise InputError(_one_line(complaint.getvalue(), argv)) from None


def _summary(name: str, argv: Sequence[str]) -> str:
    """Return what a verb does: in full where its own help is asked for, else the first line."""
    text = inspect.getdoc(VERBS[name]) or ""
    return text if argv[0] == name else text.split("\n")[0]


@contextlib.contextmanager
def _width(argv: Sequence[str]) -> Iterator[None]:
    """Let complaints be wide, so that joining their lines breaks no word; help keeps its width."""
    if "--help" in argv or "-h" in argv:
        yield
        return
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "1000"
    try:
        yield
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before


def _one_line(box: str, argv: Sequence[str]) -> str:
    """Return the first paragraph of tyro's boxed complaint."""
    words: list[str] = []
    # The first line is the box's title; boxes are plain where the terminal has no UTF-8.
    for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()[1:]:
        text = line.strip("│╭╮╰╯| ").strip()
        if not set(text) <= {"─", "-"}:
            words.append(text)
        elif words:
            break
    message = re.sub(r"^Error parsing ", "", " ".join(words)) or "cannot read the arguments"
    message = re.sub(r"^Missing from odomap \w+: (\S+).*", r"\1 is missing", message)
    message = re.sub(
        r"no type matching \{None\}\|(\S+) could be instantiated from \['(.*)'\]",
        r"\1 expected, got '\2'",
        message,
    )
    return f"{message.rstrip('.')} (see odomap {argv[0] if argv[0] in VERBS else ''} --help)"


def _options(verb: str) -> list[str]:
    return [field.name.replace("_", "-") for field in dataclasses.fields(VERBS[verb])]
