"""Write the table of docs/public.md from a folder that ``sysid bench public`` wrote.

Run ``sysid bench public --out DIR`` and then ``python docs/make_public_table.py DIR``.
"""

from __future__ import annotations

import sys
from pathlib import Path

from harness.benchmark.public import read_public
from harness.benchmark.public.tables import markdown_table

PAGE = Path(__file__).parent / "public.md"
BEGIN, END = "<!-- public table -->\n", "<!-- end of table -->"


def main(folder: str) -> None:
    """Replace what stands between the marks of the page."""
    result = read_public(folder)
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items() if version != "not installed")
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    table = f"{BEGIN}\n{result}. Versions: {versions}.\n\n{markdown_table(result)}\n{END}"
    PAGE.write_text(before + table + after, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
