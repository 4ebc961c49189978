"""Hooks of MkDocs: the pages of the site are the files of the repository where they lie, and a page for each room.

Links between pages are those of the repository, so that they work on a Git host as well. Names such as `je.prepare` in
the text become links to the pages of their rooms.
"""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from public_names import linked, public_names, public_path, room_page

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", "*/README.md", "data/schema/README.md")
FILES = ("docs/**/*.png", "docs/site/*.css", "docs/site/*.js", "jaxeit/skin/skins/*.toml", "calib/bench/scenes/*.toml",
         "data/sessions/*.toml", "examples/notebooks/*.ipynb")  # fmt: skip
EXAMPLE = re.compile(r"\]\((\w+)\.py\)")
RAISED = re.compile(r"(field-body\">\s*<code>)(\(?\w+(?:, \w+)*\)?)(?=</code>)")
REFERENCE = re.compile(r"(<autoref\b[^>]*\bidentifier=\")([\w.]+)(?=\")")


def _with_programs(text: str) -> str:
    """The list of examples, and below it the programs themselves."""
    programs = {name: (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8") for name in EXAMPLE.findall(text)}
    picture = "\n## {0}\n\n![{0}](../docs/examples/{0}.png)\n\n```python\n{1}```\n"
    shown = [picture.format(name, program) for name, program in programs.items()]
    return EXAMPLE.sub(r"](#\1)", text) + "".join(shown)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Put the files of the repository and the pages of the rooms in the place of what MkDocs found under docs/."""
    kept = [file for file in files if file.src_dir != config.docs_dir]
    paths = sorted({path for pattern in (*PAGES, *FILES) for path in ROOT.glob(pattern)})
    ours = [File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)) for path in paths]
    for path, names in public_names().items():
        ours.append(File.generated(config, f"api/{path}.md", content=room_page(path, names)))
    return Files([*kept, *ours])


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    if page.file.src_uri == "examples/README.md":
        return _with_programs(markdown)
    return markdown if page.file.src_uri.startswith("api/") else linked(markdown)


def on_page_content(html: str, **_: object) -> str:
    """Let references lead to the page of a name, whichever module has it, and the errors of a list to theirs."""

    def error(found: re.Match[str]) -> str:
        return found[1] + re.sub(r"\w+", r'<autoref identifier="\g<0>" optional>\g<0></autoref>', found[2])

    return REFERENCE.sub(lambda found: found[1] + (public_path(found[2]) or found[2]), RAISED.sub(error, html))
