"""The house keeps its shape: floors, sizes, names, and what an import may cost."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import grimp
import pytest
from importlinter import cli

import odomap

SOURCE = Path(odomap.__file__).parent
ROOT = Path(__file__).parent.parent
FILES = sorted(SOURCE.rglob("*.py"))
BANNED = {"utils", "util", "common", "helpers", "helper", "base", "manager", "misc", "core"}

THREADS = {"threading", "queue", "multiprocessing", "_thread", "asyncio"}
MAY_IMPORT_THREADS = {
    "compiling.py": "a helper process that ends with its caller",
    "system/worker.py": "Ctrl-C as an event",
    "system/background.py": "runs the stages beside the tracker",
    "system/feed.py": "reads a source that does not wait",
    "system/live.py": "tells observers that may be slow",
    "maps/skeleton.py": "the lock of the map",
    "run.py": "Ctrl-C as an event",
    "viewing.py": "draws what a run tells it, and tells the run nothing",
}

MAX_FILE, MAX_FUNCTION, MAX_KERNEL = 400, 60, 120


def name_of(path):
    return str(path.relative_to(SOURCE))


@pytest.fixture(scope="module")
def graph():
    """Return who imports whom, imports within functions and for types only included."""
    return grimp.build_graph("odomap", cache_dir=None)


@cache
def modules():
    return [(path, ast.parse(path.read_text("utf-8"))) for path in FILES]


def of_each_module(check):
    """Make one test of a check of a module: it tells the faults of all of them at once."""

    def test():
        assert len(modules()) > 100
        faults = []
        for path, tree in modules():
            try:
                check(path, tree)
            except AssertionError as error:
                faults.append(f"{name_of(path)}: {error}")
        assert not faults, "\n".join(faults)

    return test


def test_rooms_stand_on_floors(capsys):
    code = cli.lint_imports(config_filename=str(ROOT / ".importlinter"), no_cache=True)
    assert code == cli.EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_nobody_imports_the_face(graph):
    assert graph.find_modules_that_directly_import("odomap") == set()


def test_the_graph_counts_lazy_and_type_only_imports(graph):
    # odomap.maps.keyframes imports Features for its types only, odomap.kernels numba when called
    assert "odomap.vision.features" in graph.find_modules_directly_imported_by(
        "odomap.maps.keyframes"
    )
    lazy = graph.find_modules_directly_imported_by("odomap.run")
    assert "odomap.sources.open" in lazy


@of_each_module
def test_a_file_is_short(path, tree):
    lines = len(path.read_text("utf-8").splitlines())
    assert lines <= MAX_FILE, f"{lines} lines"


def is_kernel(function):
    decorators = (d.func if isinstance(d, ast.Call) else d for d in function.decorator_list)
    return any(isinstance(d, ast.Name) and d.id == "kernel" for d in decorators)


def length_of_docstring(node):
    """Return its lines, which do not count as the function's: what explains may be long."""
    return node.body[0].end_lineno - node.body[0].lineno + 1 if ast.get_docstring(node) else 0


@of_each_module
def test_a_function_is_short(path, tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = node.end_lineno - node.lineno + 1 - length_of_docstring(node)
            limit = MAX_KERNEL if is_kernel(node) else MAX_FUNCTION
            assert lines <= limit, f"{node.name} has {lines} lines of {limit}"


@of_each_module
def test_a_module_says_what_it_offers(path, tree):
    if path.name in ("__init__.py", "__main__.py") and path.parent != SOURCE:
        return  # a room's door: its modules say it
    if path == SOURCE / "__main__.py":
        return
    targets = [
        node.targets[0].id
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    ]
    assert "__all__" in targets, "has no __all__"


@of_each_module
def test_a_module_explains_itself(path, tree):
    text = ast.get_docstring(tree)
    assert text, "has no docstring"
    assert len(text.splitlines()) <= 25, "the docstring is over 25 lines"


@of_each_module
def test_no_module_is_a_drawer(path, tree):
    assert path.stem not in BANNED
    assert not set(path.relative_to(SOURCE).parts[:-1]) & BANNED


@of_each_module
def test_no_module_keeps_state(path, tree):
    for node in ast.walk(tree):
        assert not isinstance(node, ast.Global), f"line {node.lineno}: global"
    for node in tree.body:
        values = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(values, ast.List | ast.Set | ast.ListComp | ast.SetComp):
            assert isinstance(target, ast.Name)
            assert target.id == "__all__", f"line {node.lineno}: a mutable {target.id}"


def test_importing_the_face_is_light():
    code = (
        "import sys, odomap; print(*sorted({'numba', 'cv2', 'scipy', 'numpy'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numba", "cv2"} & set(run.stdout.split())


@of_each_module
def test_only_the_worker_makes_threads(path, tree):
    imported = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    imported |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert not imported & THREADS or name_of(path) in MAY_IMPORT_THREADS
