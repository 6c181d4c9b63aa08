"""The project does not grow unnoticed: a limit may be raised, but by intention."""

import runpy

import pytest
from lint import ROOT

SIZE = runpy.run_path(str(ROOT / "tools" / "size.py"))


@pytest.mark.parametrize("name", SIZE["LIMITS"])
def test_the_size_is_within_its_limit(name):
    assert SIZE["COUNTS"][name]() < SIZE["LIMITS"][name], "see tools/size.py"
