"""The examples and the README's code run as they are printed."""

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))


def test_there_are_examples():
    assert EXAMPLES


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short(path):
    assert len(path.read_text().splitlines()) < 60


def test_first_run(tmp_path):
    picture = tmp_path / "path.png"
    main = runpy.run_path(str(ROOT / "examples" / "01_first_run.py"))["main"]
    assert main(str(picture), "sim:room?seed=3&frames=10") < 0.02
    assert picture.read_bytes().startswith(b"\x89PNG")


def readme_block(language: str, containing: str) -> str:
    blocks = (ROOT / "README.md").read_text().split("```")[1::2]
    found = [b for b in blocks if b.startswith(language) and containing in b]
    assert len(found) == 1
    return found[0].removeprefix(language)


def test_readme_code_runs(tmp_path):
    code = readme_block("python", "import odomap").replace("frames=60", "frames=8")
    lines = [line for line in code.splitlines() if line.strip()]
    assert len(lines) == 5
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=300)
    assert len((tmp_path / "poses.tum").read_text().splitlines()) == 9


def test_readme_links_lead_somewhere():
    import re

    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text()):
        if "://" not in target:
            assert (ROOT / target).exists(), target
