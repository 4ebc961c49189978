"""Every block of every page is run by a test, or stands in the short list here, and then its page says so.

What a block is: a program or a file by its language or its name, a command by its line.
"""

import re
import tomllib

import pytest

from .test_docs import blocks
from .test_page_commands import commands

OWN_SKIN = "test_docs.py"
RUN = {
    "README.md": {"python": "test_readme.py"},
    "data/schema/README.md": {"python": "test_docs.py"},
    "docs/a-week-later.md": {"python": "test_programs.py", "": "test_page_commands.py"},
    "docs/checklist.md": {"": "test_page_commands.py"},
    "docs/commands.md": {"toml": "test_page_commands.py"},
    "docs/contact-layer.md": {"py": "test_page_commands.py"},
    "docs/costs.md": {"python": "test_program_cache.py"},
    "docs/electrodes.md": {"python": "test_docs.py", "py": "test_page_commands.py"},
    "docs/firmware.md": {"main.c": "export/test_c_header.py"},
    "docs/fitting.md": {"python": "test_docs.py"},
    "docs/from-eidors.md": {"python": "test_tutorials.py", "matlab": "test_eidors_pages.py"},
    "docs/from-pyeit.md": {"python": "test_tutorials.py", "with_pyeit.py": "test_tutorials.py"},
    "docs/images.md": {"python": "test_docs.py"},
    "docs/import.md": {"python": "test_docs.py", "": "test_page_commands.py"},
    "docs/lerobot.md": {"py": "export/test_lerobot_page.py", "": "export/test_lerobot_page.py"},
    "docs/live.md": {"": "test_page_commands.py"},
    "docs/loads.md": {"python": "test_docs.py", "py": "test_page_commands.py"},
    "docs/logs.md": {"python": "test_programs.py", "": "test_page_commands.py"},
    "docs/mujoco.md": {"python": "simulators/test_mujoco.py", "": "test_page_commands.py"},
    "docs/own-classes.md": {"python": "registry/test_own_classes.py", "toml": "registry/test_own_classes.py"},
    "docs/own-recordings.md": {"python": OWN_SKIN, "": OWN_SKIN},
    "docs/own-skin.md": {"python": OWN_SKIN, "": OWN_SKIN, "my_skin.toml": OWN_SKIN, "my_scene.toml": OWN_SKIN},
    "docs/proposal.md": {"python": "test_docs.py", "": "test_page_commands.py"},
    "docs/ros.md": {"": "test_page_commands.py"},
    "docs/scenes.md": {"toml": "test_docs.py"},
    "docs/speed.md": {"python": "test_batches.py"},
    "docs/tanks.md": {
        "python": "tanks/test_tanks.py",
        "matlab": "test_eidors_pages.py",
        "tank.toml": "test_page_commands.py",
        "tank_with_pyeit.py": "test_tutorials.py",
        "": "test_page_commands.py",
    },
    "docs/tracks.md": {"python": "test_docs.py"},
    "docs/train.md": {"python": "test_tutorials.py"},
    "docs/training-frames.md": {"python": "batch/test_random_frames.py", "": "test_page_commands.py"},
    "docs/wire-format.md": {"c": "record/test_wire.py", "": "test_page_commands.py"},
    **{f"docs/which-{name}.md": {"python": "test_docs.py", "": "test_docs.py"} for name in ("curve", "fidelity")},
    **{f"docs/which-{name}.md": {"python": "test_docs.py", "": "test_docs.py"} for name in ("location", "method")},
    **{f"docs/which-{name}.md": {"python": "test_docs.py", "": "test_docs.py"} for name in ("precision", "prior")},
    "docs/which-scan.md": {"python": "test_docs.py", "protocol.toml": "test_docs.py"},
    "docs/which-solver.md": {"python": "test_docs.py", "recipe.toml": "test_docs.py"},
}
"""The test that runs the blocks of each language, or of each name, of each page."""

OTHER_COMMANDS = {
    "CONTRIBUTING.md": ("make lint", "make docs"),
    "README.md": ("make demo", "make test"),  # the latter by .ci/run
    "docs/live.md": ("rerun --bind 127.0.0.1 &",),
    "docs/own-skin.md": ("make demo", ". .venv/bin/activate", "mkdir my-skin && cd my-skin", "sed -e "),
    "docs/release.md": (
        "sed -i ",
        "python -m build",
        "git checkout README.md",
        "tar xzf dist/",
        "make -C /tmp/jaxeit-* test",
    ),
}
"""How commands begin that are not those of jaxeit, and that a test runs."""

NOT_RUN = {
    "CONTRIBUTING.md": ("make test", "make slow", "make pages"),
    "benchmarks/README.md": ("python -m benchmarks",),
    "docs/lerobot.md": ("lerobot-record ",),
}
"""How commands begin that no test runs; each page says so."""

INSTALLS = re.compile(r"(?:python -m )?pip install (?:-e )?(?:'(?:jaxeit|\.)\[(\w+)\]'|\./(\S+)|build)")


def pages(root):
    """The pages that the site shows, by their paths."""
    contents = (root / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    return re.findall(r"^ *- (?!api/)(\S+\.md)$", contents, re.MULTILINE)


def shell_lines(root, page):
    """The lines of the blocks without a language and without a name, without what explains them."""
    for language, title, text in blocks(root / page):
        for line in re.sub(r"\\\n *|\n {4}(?=\S)", "", text).splitlines() if not (language or title) else ():
            words = re.split(r"(?<=\S) {3,}(?=\S)|(?:^| +)#", line)[0]
            if words:
                yield words


def is_run_or_listed(root, page, line):
    """Whether a test runs a command, or what it installs is there, or it is in the list of what no test runs."""
    extras = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    if line in commands(root / page) or line.startswith(OTHER_COMMANDS.get(page, ()) + NOT_RUN.get(page, ())):
        return True
    installed = INSTALLS.fullmatch(line)
    return installed is not None and (
        (installed[1] is None or installed[1] in extras)
        and (installed[2] is None or (root / installed[2] / "pyproject.toml").exists())
    )


def test_every_block_of_a_page_has_its_test(root):
    assert RUN.keys() <= set(pages(root))
    for page in pages(root):
        named = {title or language for language, title, _ in blocks(root / page)} - {"text", ""}
        if any(line.startswith("jaxeit ") for line in shell_lines(root, page)):
            named.add("")
        assert named == RUN.get(page, {}).keys(), page
        for test in set(RUN.get(page, {}).values()):
            text = (root / "tests" / test).read_text(encoding="utf-8")
            assert page.rpartition("/")[2] in text or "DECISIONS" in text, (page, test)


def test_make_pages_runs_these_tests(root):
    text = (root / "Makefile").read_text(encoding="utf-8")
    (shown,) = re.findall(r"^SHOWN := ((?:.*\\\n)*.*)", text, re.MULTILINE)
    tests = {test for page in RUN.values() for test in page.values()}
    assert tests <= {f"{name}.py" for name in shown.replace("\\", "").split()}
    assert "make pages" in (root / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8")


def test_every_command_of_a_page_is_run_or_listed(root):
    for page in pages(root):
        left = [line for line in shell_lines(root, page) if not is_run_or_listed(root, page, line)]
        assert left == [], page


@pytest.mark.parametrize("page", NOT_RUN)
def test_pages_say_what_no_test_runs(page, root):
    assert re.search(r"\b[Nn]o test runs\b", (root / page).read_text(encoding="utf-8"))
    lines = list(shell_lines(root, page))
    assert all(any(line.startswith(begin) for line in lines) for begin in NOT_RUN[page])


def test_blocks_of_text_hold_no_command(root):
    for page in pages(root):
        for language, _, text in blocks(root / page):
            assert language != "text" or not re.search(r"^(jaxeit|python|pip|make|sed|git) ", text, re.MULTILINE), page
