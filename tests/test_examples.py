"""Every public name has an example that runs."""

import doctest

import pytest
import torch

import dvae


@pytest.mark.parametrize("name", dvae.__all__)
@pytest.mark.filterwarnings("ignore:.*it is shortened to:UserWarning")
def test_the_example_of_a_public_name_runs(name, capsys):
    names = {"dvae": dvae, "torch": torch}
    tests = doctest.DocTestFinder(recurse=False).find(getattr(dvae, name), name, globs=names)
    examples = [each for each in tests if each.examples]
    assert examples, f"dvae.{name} has no example"
    assert sum(doctest.DocTestRunner().run(each).failed for each in examples) == 0, capsys.readouterr().out
