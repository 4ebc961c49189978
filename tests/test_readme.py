"""The README's program runs, and its commands and links exist."""

import re

import numpy as np
import pytest

from benchmarks.harness import measured
from benchmarks.readme import PAGES
from benchmarks.tables import filled
from calib.cli import COMMANDS


def test_the_program_of_the_first_screen_runs(root, capsys):
    text = (root / "README.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names: dict = {}
    exec(compile(program, "README.md", "exec"), names)
    assert float(capsys.readouterr().out) == pytest.approx(12.0, rel=1e-12)
    assert np.linalg.norm(np.asarray(names["where"]) - [0.06, 0.13]) < 5e-3
    assert names["v"].shape == (550,)
    assert names["image"].shape == (1600,)


def test_commands_and_links(root):
    text = (root / "README.md").read_text()
    described = (root / "docs" / "commands.md").read_text()
    assert set(re.findall(r"^\| `jaxeit (\w+)", text, re.MULTILINE)) == set(COMMANDS)
    assert set(re.findall(r"^`jaxeit (\w+)", described, re.MULTILINE)) == set(COMMANDS)
    text += (root / "CONTRIBUTING.md").read_text()
    for target in re.findall(r"^make (\w+)", text, re.MULTILINE):
        assert f"\n{target}:" in (root / "Makefile").read_text()


def test_results_table_is_filled(root):
    text = (root / "README.md").read_text()
    table = text[text.index("<!-- results") : text.index("<!-- end of results")]
    assert table.count("|") > 20


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_are_those_of_the_stored_results(page):
    text = page.read_text(encoding="utf-8")
    assert filled(text, measured()) == text
