"""The measures of how the code is built, on a small tree whose numbers are known."""

import pytest

from benchmarks import house

FILES = {
    "jaxeit/__init__.py": "",
    "jaxeit/__init__.pyi": "from . import low\nfrom .high import top as top\nfrom .low.base import a as a, b as b\n",
    "jaxeit/low/__init__.py": "",
    "jaxeit/low/base.py": '"""Base."""\n\n\ndef a():\n    """A docstring."""\n    return 1  # why\n',
    "jaxeit/middle.py": "from .low.base import a\n",
    "jaxeit/high.py": "import jaxeit.middle\n\n\ndef top():\n    return jaxeit.middle\n",
    "calib/__init__.py": '__all__ = ["one"]\n',
    "calib/alone.py": "import jaxeit\n",
    "README.md": "1 of 20, 3.5 %\nend\n",
    "examples/first.py": "",
}


@pytest.fixture
def tree(tmp_path):
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return house.Tree(tmp_path, "HEAD")


@pytest.mark.parametrize(
    ("measure", "expected"),
    [
        (house.top_modules, (3, 2)),
        (house.import_depths, (3, 1)),
        (house.public_names, (3, 1)),
        (house.function_lengths, (2, 2)),
        (house.docstrings, 50.0),
        (house.readme_numbers, (3, 2)),
        (house.example_programs, 1),
        (house.checks_annotations, False),
        (house.comments, 100 / 14),
    ],
    ids=lambda one: getattr(one, "__name__", ""),
)
def test_a_measure_counts_what_it_says(tree, measure, expected):
    assert measure(tree) == pytest.approx(expected)


def test_an_aim_is_reached_by_all_values_or_not():
    within = house._each_within(12, 8)
    assert [within((12, 8)), within((12, 9))] == [True, False]
