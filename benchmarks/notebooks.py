"""Four examples as notebooks, each with a picture at its end: the cells are run, and their output is kept.

python -m benchmarks.notebooks
"""

import ast
import base64
import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib import pyplot

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "examples" / "notebooks"
PICTURES = {
    "where_is_the_contact": (
        "axes = je.plot.show_image(model, touched - model.background)\nje.plot.show_contacts(contacts, axes);"
    ),
    "image_and_forces": "je.plot.show_image(recon, fmap.pressure / 1e3).set_title('kPa');",
    "two_fingers": (
        "from matplotlib import pyplot\n\n"
        "for distance, image in zip(distances, images, strict=True):\n"
        "    pyplot.plot(image[20] / image[20].max(), label=f'{1e3 * distance:.0f} mm')\n"
        "pyplot.gca().set(xlabel='pixel', ylabel='image through both')\n"
        "pyplot.legend();"
    ),
    "gradient_of_a_loss": (
        "axes = je.plot.show_skin(je.load_skin('testbed'))\n"
        "axes.plot(*1e3 * truth, 'o', label='true')\n"
        "axes.plot(*1e3 * guess[:2], 'x', label='found')\n"
        "axes.legend();"
    ),
}
"""The last cell of each notebook."""


def cells_of(name: str) -> tuple[str, list[str]]:
    """The question of an example, and its program in cells that end where a blank line does."""
    source = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
    question, *statements = ast.parse(source).body
    lines, parts, begin = source.splitlines(), [], (question.end_lineno or 0) + 1
    for now, after in zip(statements, [*statements[1:], None], strict=True):
        end = now.end_lineno or 0
        told = after is not None and isinstance(after, ast.Import | ast.ImportFrom)
        if after is None or (not told and not lines[end].strip()):
            parts.append("\n".join(lines[begin : end if after is not None else None]).strip())
            begin = end
    return str(ast.literal_eval(question.value)) if isinstance(question, ast.Expr) else name, parts


Cell = dict[str, Any]


def executed(cells: list[str]) -> Iterator[Cell]:
    """The cells with what they print, and the picture that the last one draws."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(cells, 1):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(cell, f"cell {number}", "exec"), names)
        text = printed.getvalue()
        outputs: list[Cell] = [{"output_type": "stream", "name": "stdout", "text": text}] if text else []
        for figure in map(pyplot.figure, pyplot.get_fignums()):
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=80, metadata={"Software": None})
            data = {"image/png": base64.b64encode(buffer.getvalue()).decode(), "text/plain": "<Figure>"}
            outputs.append({"output_type": "display_data", "data": data, "metadata": {}})
        pyplot.close("all")
        about = {"id": f"cell-{number}", "metadata": {}, "execution_count": number}
        yield {"cell_type": "code", "source": cell, "outputs": outputs} | about


def main() -> None:
    matplotlib.use("Agg")
    FOLDER.mkdir(exist_ok=True)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    for name, picture in PICTURES.items():
        question, cells = cells_of(name)
        about = f"# {name.replace('_', ' ').capitalize()}\n\n{question}\n\nNeeds `pip install 'jaxeit[plot]'`."
        head = {"cell_type": "markdown", "source": about, "id": "question", "metadata": {}}
        notebook = {
            "cells": [head, *executed([*cells, picture])],
            "metadata": {"kernelspec": kernel},
            "nbformat": 4,
            "nbformat_minor": 5,
        }
        text = json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
        (FOLDER / f"{name}.ipynb").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
