"""The documentation site shows every public name once, and asks nothing of the network."""

import ast
import dataclasses
import os
import re
import subprocess
import sys
from collections import Counter
from html.parser import HTMLParser
from importlib import import_module, util
from inspect import getdoc, isclass, isfunction, isroutine
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest

import calib
import jaxeit as je
from benchmarks.house import Tree, public_names
from tests.test_laws import _own_methods, _public_names


@pytest.fixture(scope="module")
def names(root):
    """The module of the site that knows the public names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(root / "docs" / "site"))
        yield import_module("public_names")


@pytest.fixture(scope="module")
def pages(names):
    """Path of each room -> its page as it is given to MkDocs."""
    return {path: names.room_page(path, listed) for path, listed in names.public_names().items()}


def test_every_public_name_is_shown_once(pages):
    shown = Counter(
        line.rpartition(".")[2] for page in pages.values() for line in page.splitlines() if line.startswith("::: ")
    )
    public = {name for name, (thing, *_) in _public_names().items() if not isinstance(thing, ModuleType)}
    assert public <= shown.keys()
    assert [name for name, times in shown.items() if times > 1] == []


def test_every_page_of_a_room_is_in_the_contents(pages, root):
    contents = re.findall(r"^ +- api/(.*)\.md$", (root / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(contents) == sorted(pages)


def test_names_are_headed_as_users_type_them(pages):
    assert "heading: je.Noser}" in pages["jaxeit.imaging"]
    assert "heading: je.effects.Creep}" in pages["jaxeit.effects"]
    assert "heading: calib.record.Source}" in pages["calib.record"]


def test_names_lead_to_the_programs_that_use_them(pages, root):
    lines = pages["jaxeit.fusion"].splitlines()
    after = lines[lines.index("::: jaxeit.fusion.fuse") :]
    said = next(line for line in after if line.startswith("In use: "))
    assert "[image_and_forces](../examples/README.md#image_and_forces)" in said
    addresses = {address for page in pages.values() for address in re.findall(r"\]\(\.\./([^)#]+)", page)}
    assert addresses
    assert [address for address in addresses if not (root / address).is_file()] == []


def test_everyday_names_are_used_in_programs(names, root):
    everyday = {name: getattr(package, name) for package in (je, calib) for name in package.__all__}
    listed = [name for name, thing in everyday.items() if not isinstance(thing, ModuleType)]
    assert len(listed) == sum(public_names(Tree(root, "HEAD")))  # as the stubs have them
    assert [name for name in listed if not names.has_program(name)] == []


def test_every_function_is_used_in_a_program_and_the_links_of_every_other_name_lead_to_one(names):
    public = {name: thing for listed in names.public_names().values() for name, thing in listed.items()}
    assert [name for name, thing in public.items() if isroutine(thing) and not names.has_program(name)] == []
    assert [name for name in public if not names.leads_to_program(name)] == []


def test_every_room_begins_with_a_program(names, pages):
    for path, page in pages.items():
        head = page.partition("\n## ")[0]
        assert "```python\n" in head, f"give the docstring of {path} a section Example"
        assert names.room_program(path).count("\n") >= 5, path


def _described_values(module):
    """Names of the values of a module that a docstring follows."""
    lines = ast.parse(Path(module.__file__).read_text(encoding="utf-8")).body
    for line, after in pairwise(lines):
        if isinstance(line, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr):
            yield from (part.id for part in ast.walk(line) if isinstance(part, ast.Name))


def _undescribed(name, thing, values):
    """A public name without a docstring, and methods and properties that neither its class nor a base describes."""
    if not (getdoc(thing) if isroutine(thing) or isclass(thing) else (name, id(thing)) in values):
        yield name
    methods = [part for part in _own_methods(thing) if isfunction(part)] if isclass(thing) else []
    described = {part.__name__ for part in methods if part.__doc__}
    yield from (f"{name}.{method}" for method in sorted({part.__name__ for part in methods} - described))


def test_every_public_name_has_a_docstring(names):
    public = {name: thing for listed in names.public_names().values() for name, thing in listed.items()}
    ours = [module for path, module in sys.modules.items() if path.partition(".")[0] in ("jaxeit", "calib")]
    values = {(name, id(vars(module).get(name))) for module in ours for name in _described_values(module)}
    assert [missing for name, thing in public.items() for missing in _undescribed(name, thing, values)] == []


def test_every_field_of_a_public_class_is_explained(names):
    """In the docstring of the class or of one that it derives from."""
    missing = []
    for name, thing in ((n, t) for listed in names.public_names().values() for n, t in listed.items() if isclass(t)):
        fields = [field.name for field in dataclasses.fields(thing)] if dataclasses.is_dataclass(thing) else []
        family = [base for base in thing.__mro__ if base.__module__.partition(".")[0] in ("jaxeit", "calib")]
        words = set(re.findall(r"\w+", " ".join(base.__doc__ or "" for base in family)))
        given = [field for field in [*fields, *getattr(thing, "_fields", ())] if not field.startswith("_")]
        missing += [f"{name}.{field}" for field in given if field not in words]
    assert missing == []


def test_summaries_of_values_are_their_own_docstrings(pages):
    assert "[`calib.fitting.logs.MIN_PLACES`][calib.fitting.logs.MIN_PLACES]: Places of" in pages["calib.fitting.logs"]
    assert ": Finer than that of a calibration" in pages["calib.bench"]


def test_a_class_of_another_package_with_the_name_of_a_public_one_is_not_taken_for_it(names, pages):
    """Such as the path of a file for the path of a stage."""
    (entry,) = [part for part in pages["jaxeit.effects"].split("::: ") if part.startswith("jaxeit.effects.Path\n")]
    assert "[`je.effects.StageError`]" in entry
    assert "load_skin" not in entry
    assert names.public_path("jaxeit.skin.description.Skin") == "jaxeit.skin.Skin"
    assert names.public_path("pathlib.Path") is None


def test_names_in_docstrings_become_links(names):
    said = names.linked("see `Noser`, `je.Noser(0.5)`, `prior` and [`Noser`](x)", "jaxeit.imaging.preparation")
    assert said == (
        "see [`Noser`][jaxeit.imaging.Noser], [`je.Noser(0.5)`][jaxeit.imaging.Noser], `prior` and [`Noser`](x)"
    )
    assert names.linked("`Noser`, `je.Noser`") == "`Noser`, [`je.Noser`][jaxeit.imaging.Noser]"
    assert names.linked("see `Path`", "jaxeit.effects.stage") == "see [`Path`][jaxeit.effects.Path]"
    assert names.linked("see `Path`", "calib.session.writer") == "see `Path`"  # that of the standard library


def test_programs_are_found_by_what_they_import(names):
    used = sys.modules["programs"].used_in
    public, rooms = names.identifiers(), names.rooms()
    text = "from jaxeit.imaging import (\n    Laplace,\n    Noser as Prior,\n)\nje.Fidelity.draft()\n"
    text += "calib.session.importers.StatedFacts"
    assert used(text, public, rooms) == {"Laplace", "Noser", "Fidelity", "StatedFacts"}
    assert used("effects.Creep()", public, rooms) == set()
    assert used("effects.Creep()", public, rooms, "from jaxeit import effects") == {"Creep"}


def test_pages_name_what_returns_takes_and_raises(pages):
    entries = {name.split("\n")[0]: name for page in pages.values() for name in page.split("::: ")[1:]}
    assert "Returned by: [`je.prepare_contacts`]" in entries["jaxeit.contacts.ContactFinder"]
    assert "Kinds: " in entries["jaxeit.imaging.AbstractPrior"]
    assert "Raised by: " in entries["jaxeit.imaging.InverseError"]
    assert "[`je.fit_background`][jaxeit.imaging.fit_background]" in entries["jaxeit.imaging.InverseError"]


class Page(HTMLParser):
    """What a browser loads for a page, and the headings that links may lead to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.headings: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag in ("script", "img", "iframe", "source"):
            self.loaded.append(given.get("src") or "")
        if tag == "link" and given.get("rel") in ("stylesheet", "icon", "preload", "preconnect"):
            self.loaded.append(given["href"])
        if tag == "h3" and "id" in given:
            self.headings.append(given["id"])


@pytest.mark.slow
@pytest.mark.skipif(util.find_spec("mkdocs") is None, reason="the extra docs is not installed")
def test_the_site_is_built_and_whole(pages, root, tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    read = {path: Page(path.read_text(encoding="utf-8")) for path in (tmp_path / "site").rglob("*.html")}
    assert [url for page in read.values() for url in page.loaded if re.match(r"(https?:)?//", url)] == []
    for path, page in pages.items():
        expected = re.findall(r"^::: (.*)$", page, re.MULTILINE)
        headings = Counter(read[tmp_path / "site" / "api" / f"{path}.html"].headings)
        assert {name: headings[name] for name in expected} == dict.fromkeys(expected, 1)
    styles = "".join(path.read_text(encoding="utf-8") for path in (tmp_path / "site").rglob("*.css"))
    assert re.findall(r"url\(['\"]?(?:https?:)?//", styles) == []
