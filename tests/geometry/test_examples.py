import doctest
import importlib
import pkgutil

import numpy as np
import pytest

import odomap.geometry

MODULES = [m.name for m in pkgutil.iter_modules(odomap.geometry.__path__)]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_in_docstrings_run(name):
    module = importlib.import_module(f"odomap.geometry.{name}")
    with np.printoptions(legacy=False):
        result = doctest.testmod(module, extraglobs={"np": np}, optionflags=doctest.ELLIPSIS)
    assert result.failed == 0


def test_there_are_examples():
    finder = doctest.DocTestFinder()
    with_examples = [
        name
        for name in MODULES
        for test in finder.find(importlib.import_module(f"odomap.geometry.{name}"))
        if test.examples
    ]
    assert len(with_examples) >= 8
