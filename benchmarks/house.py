"""How the code is built, in numbers: rooms, depth of imports, public names, functions, comments, examples, commits.

python -m benchmarks.house                # the first version and this one; writes results/house.json
python -m benchmarks.house REVISION ...   # prints those of any commits

A revision is read from `git archive`, so that the working tree stays as it is. What counts is stated beside each
measure; the aims, and what packages of the field have, were noted when the first version was measured by hand.
"""

import argparse
import ast
import io
import json
import re
import statistics
import subprocess
import sys
import tarfile
import tempfile
import tokenize
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from pathlib import Path

from .markdown import markdown
from .rows import Row

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results" / "house.json"
PACKAGES = ("jaxeit", "calib")
FIRST = "b17626e"  # the last commit in which the modules stood side by side
MAX_ROOM, MAX_DEPTH, MAX_NAMES, MAX_FILE, MAX_SUBJECT = 12, 8, (60, 30), 400, 72
LAST_SUBJECTS = 100  # commits whose subjects count, up to the one that is measured


class Tree:
    """The files of a commit, in a folder."""

    def __init__(self, folder: Path, commit: str):
        self.folder, self.commit = folder, commit

    def files(self, package: str) -> list[Path]:
        return sorted((self.folder / package).rglob("*.py"))

    @cached_property
    def sources(self) -> dict[Path, str]:
        return {path: path.read_text(encoding="utf-8") for name in PACKAGES for path in self.files(name)}

    @cached_property
    def parsed(self) -> dict[Path, ast.Module]:
        return {path: ast.parse(text) for path, text in self.sources.items()}

    @cached_property
    def readme(self) -> str:
        return (self.folder / "README.md").read_text(encoding="utf-8")

    def nodes(self, *kinds: type) -> Iterator[ast.AST]:
        """The nodes of these kinds in all modules."""
        return (node for tree in self.parsed.values() for node in ast.walk(tree) if isinstance(node, kinds))


# --- measures, each of a tree


def largest_rooms(tree: Tree) -> tuple[int, ...]:
    """Modules side by side in one folder, the most of each package."""
    return tuple(max(_modules(path.parent) for path in tree.files(name)) for name in PACKAGES)


def top_modules(tree: Tree) -> tuple[int, ...]:
    """Modules side by side at the top of each package."""
    return tuple(_modules(tree.folder / name) for name in PACKAGES)


def _modules(folder: Path) -> int:
    return len(list(folder.glob("*.py")))


def import_depths(tree: Tree) -> tuple[int, ...]:
    """Rooms in the longest chain of imports within each package; a module at the top is a room."""
    return tuple(_depth(tree, name) for name in PACKAGES)


def _depth(tree: Tree, package: str) -> int:
    uses: dict[str, set[str]] = {}
    for path in tree.files(package):
        room = _room(tree, path)
        if room != "__init__":
            uses.setdefault(room, set()).update(_rooms_imported(tree, path, package) - {room})
    depth: dict[str, int] = {}

    def below(room: str, above: tuple[str, ...] = ()) -> int:
        if room not in depth:
            used = [one for one in uses.get(room, ()) if one in uses and one not in above]
            depth[room] = 1 + max((below(one, (*above, room)) for one in used), default=0)
        return depth[room]

    return max(map(below, uses))


def _room(tree: Tree, path: Path) -> str:
    return path.relative_to(tree.folder).parts[1].removesuffix(".py")


def _rooms_imported(tree: Tree, path: Path, package: str) -> set[str]:
    found = set()
    for node in ast.walk(tree.parsed[path]):
        if isinstance(node, ast.ImportFrom):
            name = [part for part in (node.module or "").split(".") if part]
            folder = path.relative_to(tree.folder).parts[:-1]
            whole = [*folder[: len(folder) + 1 - node.level], *name] if node.level else name
            rest = whole[1:2] or [alias.name for alias in node.names]
            found.update(rest if whole[:1] == [package] else [])
        elif isinstance(node, ast.Import):
            parts = (alias.name.split(".") for alias in node.names)
            found.update(part[1] for part in parts if part[0] == package and len(part) > 1)
    return found


def public_names(tree: Tree) -> tuple[int, ...]:
    """Names of ``je`` and of ``calib``, rooms left out: those of the stub, or of ``__all__`` where there is none."""
    return tuple(len(_names(tree.folder / name)) for name in PACKAGES)


def _names(package: Path) -> set[str]:
    stub = package / "__init__.pyi"
    parsed = ast.parse((stub if stub.exists() else package / "__init__.py").read_text(encoding="utf-8"))
    assigned = {ast.unparse(node.targets[0]): node.value for node in parsed.body if isinstance(node, ast.Assign)}
    if isinstance(assigned.get("__all__"), ast.List):
        return set(ast.literal_eval(assigned["__all__"]))
    if "_HOMES" in assigned:  # the first version: names of each module, as words
        return {name for names in ast.literal_eval(assigned["_HOMES"]).values() for name in names.split()}
    imports = (node for node in parsed.body if isinstance(node, ast.ImportFrom) and node.module)  # none: rooms
    return {alias.asname or alias.name for node in imports for alias in node.names}


def function_lengths(tree: Tree) -> tuple[int, int]:
    """Lines within which 99 % of the functions are, and of the longest; docstrings do not count."""
    lengths = sorted(map(_length, tree.nodes(ast.FunctionDef, ast.AsyncFunctionDef)))
    return lengths[int(0.99 * len(lengths))], lengths[-1]


def _length(node: ast.FunctionDef) -> int:
    first = node.body[0]
    text = ast.get_docstring(node) is not None
    return node.end_lineno - node.lineno + 1 - (first.end_lineno - first.lineno + 1 if text else 0)


def file_lengths(tree: Tree) -> tuple[int, int]:
    """Lines of the longest file, and number of files above 400."""
    lengths = [text.count("\n") for text in tree.sources.values()]
    return max(lengths), sum(length > MAX_FILE for length in lengths)


def comments(tree: Tree) -> float:
    """Comments, a share of the lines in %."""
    tokens = (one for text in tree.sources.values() for one in tokenize.generate_tokens(io.StringIO(text).readline))
    return 100 * sum(one.type == tokenize.COMMENT for one in tokens) / sum(t.count("\n") for t in tree.sources.values())


def docstrings(tree: Tree) -> float:
    """Public classes and functions of a module that have a docstring, in %."""
    kinds = ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef
    top = [node for module in tree.parsed.values() for node in module.body if isinstance(node, kinds)]
    overloads = {node for node in top if any(ast.unparse(one) == "overload" for one in node.decorator_list)}
    public = [node for node in top if not node.name.startswith("_") and node not in overloads]
    return 100 * statistics.mean(ast.get_docstring(node) is not None for node in public)


def readme_numbers(tree: Tree) -> tuple[int, int]:
    """Numbers in the README, and its lines."""
    return len(re.findall(r"\b\d[\d.,]*", tree.readme)), tree.readme.count("\n")


def example_programs(tree: Tree) -> int:
    """Programs in examples/."""
    return len(list((tree.folder / "examples").glob("*.py")))


def docstring_programs(tree: Tree) -> int:
    """Docstrings with a section ``Example``, which tests run."""
    kinds = ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef
    return sum(bool(re.search(r"^Example\b.*:", ast.get_docstring(n) or "", re.MULTILINE)) for n in tree.nodes(*kinds))


def checks_annotations(tree: Tree) -> bool:
    """Whether the tests check annotations as calls are made, by an import hook of jaxtyping."""
    files = (tree.folder / "tests").glob("*.py")
    return any("jaxtyping" in text and "hook" in text for text in (p.read_text(encoding="utf-8") for p in files))


def subject_lengths(tree: Tree) -> tuple[float, int]:
    """Characters of the subjects of the last hundred commits without merges: mean, and number above 72."""
    command = ["git", "log", "--no-merges", "--format=%s", f"-{LAST_SUBJECTS}", tree.commit]
    lengths = [len(line) for line in _said(command).splitlines()]
    return statistics.mean(lengths), sum(length > MAX_SUBJECT for length in lengths)


def strict_errors(tree: Tree) -> int | None:
    """Errors of ``mypy --strict`` in both packages; None where mypy is not installed."""
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tree.folder / ".mypy"), *PACKAGES]
    said = subprocess.run(command, cwd=tree.folder, capture_output=True, text=True, check=False)
    if said.returncode not in (0, 1) or not said.stdout:
        return None
    return int((re.search(r"Found (\d+) error", said.stdout) or ["", "0"])[1])


Measure = Callable[[Tree], object]
Reached = Callable[[object], bool]


def _each_within(*limits: float) -> Reached:
    """Whether each of several values is at most its limit."""
    return lambda found: all(value <= limit for value, limit in zip(found, limits, strict=True))


POINTS: tuple[tuple[str, Measure, str, str, str, Reached | None], ...] = (
    ("modules at the top of jaxeit, calib", top_modules, "{0}, {1}", "scikit-fem 7, tinygp 8, equinox 23",
     "at most about 12", _each_within(MAX_ROOM, MAX_ROOM)),
    ("modules of the largest room", largest_rooms, "{0}, {1}", "the same", "at most about 12",
     _each_within(MAX_ROOM, MAX_ROOM)),
    ("depth of imports, rooms", import_depths, "{0}, {1}", "lineax 6", "at most 8", _each_within(MAX_DEPTH, MAX_DEPTH)),
    ("public names of je, calib", public_names, "{0}, {1}", "tinygp 5, optimistix 63", "about 60, 30",
     _each_within(*MAX_NAMES)),
    ("lines within which 99 % of functions are; the longest", function_lengths, "{0}; {1}",
     "tinygp 52, scikit-fem 98, optimistix 119", "short functions", None),
    ("lines of the longest file; files above 400", file_lengths, "{0}; {1}", "", "at most about 400",
     _each_within(MAX_FILE, 0)),
    ("comments, share of lines", comments, "{0:.1f} %", "6 to 11 %", "where a step is hard, say why", None),
    ("public classes and functions with a docstring", docstrings, "{0:.1f} %", "", "", None),
    ("annotations checked in tests", checks_annotations, "{0}", "optimistix, lineax", "always", bool),
    ("errors of mypy --strict", strict_errors, "{0}", "optimistix (pyright)", "public rooms clean",
     lambda errors: errors == 0),
    ("numbers in the README; lines", readme_numbers, "{0}; {1}", "5 to 39 numbers", "a page of 110 lines",
     lambda found: found[1] <= 110),
    ("programs in examples/", example_programs, "{0}", "about 50", "20", lambda count: count >= 20),
    ("docstrings with a program", docstring_programs, "{0}", "", "", None),
    ("subject of the last 100 commits, characters; above 72", subject_lengths, "{0:.0f}; {1}", "36", "within 72",
     lambda found: found[1] == 0),
)  # fmt: skip
"""Point, measure, form, what the field has, aim, and whether the aim is reached; None where no number tells."""


def by_hand() -> list[Row]:
    """Points of the comparison that a reader counts, with where they are held now."""
    return [
        {"point": "loops of least squares", "field": "one", "first": "5", "now": "1", "aim": "one",
         "reached": "yes", "held": "`jaxeit/least_squares`"},
        {"point": "places that handle missing readings", "field": "one", "first": "5", "now": "1", "aim": "one algebra",
         "reached": "yes", "held": "`jaxeit/imaging/readings/missing.py`"},
        {"point": "files that a new curve, prior or effect touches", "field": "1 to 2", "first": "3 to 5",
         "now": "1, and one line", "aim": "1, and one line", "reached": "yes",
         "held": "`tests/registry/test_one_class.py`"},
    ]  # fmt: skip


def _said(command: Sequence[str]) -> str:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def measured_at(revision: str, without: Sequence[Measure] = ()) -> list[tuple[str, object]]:
    """The text and the value of each point at a commit; no text for the measures in ``without``."""
    commit = _said(["git", "rev-parse", "--short", revision]).strip()
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True).stdout
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(archive)) as files:
            files.extractall(folder, filter="data")
        tree = Tree(Path(folder), commit)
        return [_shown(form, None if measure in without else measure(tree)) for _, measure, form, *_ in POINTS]


def _shown(form: str, value: object) -> tuple[str, object]:
    if value is None:
        return "", None
    if isinstance(value, bool):
        return "yes" if value else "no", value
    return form.format(*(value if isinstance(value, tuple) else (value,))), value


def compared(first: str, now: str) -> list[Row]:
    """The table of two commits, with whether the second reaches the aims."""
    rows = []
    for point, (before, _), (after, value) in zip(POINTS, measured_at(first), measured_at(now), strict=True):
        name, _, _, field, aim, reached = point
        yes = "" if reached is None or value is None else "yes" if reached(value) else "no"
        rows.append({"point": name, "field": field, "first": before, "now": after, "aim": aim, "reached": yes})
    return rows + by_hand()


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revisions", nargs="*", metavar="REVISION", help=f"default: {FIRST} and HEAD, and write them")
    parser.add_argument("--quick", action="store_true", help="without mypy, which takes minutes")
    args = parser.parse_args(argv)
    if args.revisions:
        without = [strict_errors] if args.quick else []
        found = [[text for text, _ in measured_at(revision, without)] for revision in args.revisions]
        print(markdown(["", *args.revisions], zip((point for point, *_ in POINTS), *found, strict=True)))
        return
    rows = compared(FIRST, "HEAD")
    commits = {"first": FIRST, "now": _said(["git", "rev-parse", "--short", "HEAD"]).strip()}
    RESULTS.write_text(json.dumps({"house": commits | {"rows": rows}}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
