"""The list of guards to break fits the sources, and finds its places where names have changed."""

import pytest

from .mutations import LIST, Misfit, broken, listed, misfits, place

SOURCE = """
class Frame:
    def without(self, flags):
        weight = np.where(flags, self.inverse, 0)
        return np.where(flags, weight, 1)


def guarded(rows):
    if rows.ndim != 2:
        raise ValueError
    check(rows)
    return rows
"""


@pytest.fixture
def applied(tmp_path):
    """The source with a line of a list applied."""
    (tmp_path / "jaxeit").mkdir()
    (tmp_path / "jaxeit" / "frames.py").write_text(SOURCE)

    def apply(line):
        (mutant,) = listed(f"[test_mutations]\n{line}  # list\n")
        return broken(*place(mutant, tmp_path))

    return apply


def test_the_list_fits_the_sources():
    assert misfits(listed(LIST.read_text())) == []


@pytest.mark.parametrize(
    ("line", "new"),
    [
        ("Frame.without: np.where(flags, self.inverse, 0) => self.inverse", "weight = (self.inverse)"),
        ("Frame.without: np.where(used, self.weight, 0) => self.weight", "weight = (self.inverse)"),
        ("guarded: frames.ndim != 2 => False", "if (False):"),
        ("guarded: check(rows) => pass", "raise ValueError\n    pass\n"),
        ("Renamed.elsewhere: rows.ndim != 2 => rows.ndim != 3", "if (rows.ndim != 3):"),
    ],
)
def test_a_place_is_found_under_other_names(applied, line, new):
    assert new in applied(line)


@pytest.mark.parametrize(
    "line",
    [
        "guarded: rows.ndim != 3 => False",
        "guarded: np.where(rows, 1, 0) => rows",
        "Frame.without: np.where(a, b, c) => b",
        "Frame.without: np.where(a, b.c, 0) => b.c",
        "Renamed.elsewhere: frames.ndim != 2 => False",
    ],
)
def test_what_is_not_there_once_is_a_misfit(applied, line):
    with pytest.raises(Misfit, match="0 times"):
        applied(line)


def test_what_is_there_twice_is_a_misfit(applied):
    with pytest.raises(Misfit, match=r"[2-9] times"):
        applied("guarded: rows => rows.T")


def test_tests_that_are_not_there_are_told():
    rotten = listed("[test_mutations test_none]\n_name: no_such_text => None  # no_such_test")
    assert [line.split(": ")[0] for line in misfits(rotten)] == [
        *("_name", "test_none.py", "test_mutations test_none"),
    ]
