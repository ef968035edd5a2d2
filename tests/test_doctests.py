"""The examples in the docstrings run."""

import doctest
import importlib
import pkgutil

import pytest

import coachable

MODULES = sorted(module.name for module in pkgutil.walk_packages(coachable.__path__, "coachable.") if not module.ispkg)
EXTRAS = ("viser", "av", "onnx", "onnxruntime", "onnxscript", "captum", "gymnasium")


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    try:
        module = importlib.import_module(name)
    except ImportError as error:
        if error.name in EXTRAS:
            pytest.skip(f"{name} needs the extra that brings {error.name}")
        raise
    failed, _ = doctest.testmod(module, optionflags=doctest.ELLIPSIS)
    assert failed == 0
