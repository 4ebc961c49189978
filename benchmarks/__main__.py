"""The questions that can be asked: `python -m benchmarks` lists them, `python -m benchmarks.NAME --help` tells more."""

import ast
from pathlib import Path


def questions() -> dict[str, str]:
    """The first line of each module of this package that is a command, by name."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("[!_]*.py")):
        text = path.read_text(encoding="utf-8")
        if '__name__ == "__main__"' in text:
            found[path.stem] = (ast.get_docstring(ast.parse(text)) or "").splitlines()[0]
    return found


def main() -> None:
    for name, about in questions().items():
        print(f"python -m benchmarks.{name:18} {about}")


if __name__ == "__main__":
    main()
