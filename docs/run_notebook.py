"""Run docs/first-steps.ipynb and keep what its cells show, as Jupyter would. Run: python docs/run_notebook.py.

The cells run in this process; of the last expression of a cell its HTML (or text) is kept, and what was printed.
"""

from __future__ import annotations

import ast
import contextlib
import io
import json
import os
import tempfile
from pathlib import Path
from typing import Any

BOOK = Path(__file__).with_name("first-steps.ipynb")


def shown(source: str, names: dict[str, object]) -> list[dict[str, Any]]:
    """Run a cell among the names of those before it, and return its outputs in nbformat 4."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, BOOK.name, "exec"), names)
        value = None if last is None else eval(compile(ast.Expression(last.value), BOOK.name, "eval"), names)  # type: ignore[attr-defined]
    found: list[dict[str, Any]] = []
    if printed.getvalue():
        found.append({"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(keepends=True)})
    if value is not None:
        data: dict[str, Any] = {"text/plain": [repr(value)]}
        if hasattr(value, "_repr_html_"):
            data = {"text/html": [value._repr_html_()], **data}
        found.append({"output_type": "execute_result", "execution_count": None, "metadata": {}, "data": data})
    return found


def run(book: dict[str, Any]) -> dict[str, Any]:
    """Return a notebook with the outputs of its cells, run in the folder that is current; names in ``names``."""
    names: dict[str, object] = {"__name__": "__main__"}
    count = 0
    for cell in book["cells"]:
        if cell["cell_type"] == "code":
            count += 1
            cell["outputs"] = shown("".join(cell["source"]), names)
            cell["execution_count"] = count
            for output in cell["outputs"]:
                if output["output_type"] == "execute_result":
                    output["execution_count"] = count
    return {"book": book, "names": names}


def main() -> None:
    """Run the notebook in an empty folder and write it back."""
    book = json.loads(BOOK.read_text(encoding="utf-8"))
    home = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            run(book)
        finally:
            os.chdir(home)
    BOOK.write_text(json.dumps(book, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
