"""What holds for all tests, and how several processes share them."""

import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent

# `reference` (the plain twins of kernels) is shared by the tests of several rooms.
sys.path.insert(0, str(TESTS))

LONG = ("", "system", "real", "views", "simulation", "files", "sources")
"""Rooms with tests that take seconds, those of the command line and the face first."""


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile all kernels before processes share the tests: else each compiles them by itself."""
    option = session.config.option
    if getattr(option, "dist", "no") == "no" or option.collectonly:
        return
    option.loadscopereorder = False  # by their number of tests: what takes minutes would come last
    from odomap.compiling import compile_modules
    from odomap.kernels import modules_with_kernels

    compile_modules(modules_with_kernels(), lambda *_: None)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give long files out first, so that no process is left with one when the others are done."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: _rank(item.path))


def _rank(path: Path) -> int:
    room = path.relative_to(TESTS).parts[0] if path.parent != TESTS else ""
    return LONG.index(room) if room in LONG else len(LONG)


@pytest.fixture(scope="session", autouse=True)
def _no_lines_of_progress():
    """A command that takes seconds says so, but a slow machine is not what tests look for."""
    from odomap.cli import progress

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress, "LINE_EVERY_S", float("inf"))
        yield


@pytest.fixture
def no_report(monkeypatch):
    """Leave the report empty, where nobody looks: it takes longer than a dozen frames."""
    from odomap.views import report

    monkeypatch.setattr(report, "render_report", lambda _: "<!doctype html>\n")
