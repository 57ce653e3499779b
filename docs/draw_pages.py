"""Draw the pictures of worked pages: run the code of a page, in order, in this folder.

Run: python docs/draw_pages.py keypoints [PAGE ...]
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

FENCE = re.compile(r"^```python\n(.*?)^```\s*$", re.MULTILINE | re.DOTALL)


def main() -> None:
    """Run the blocks of every page that is named; what they save lies beside the page."""
    folder = Path(__file__).parent
    os.chdir(folder)
    for name in sys.argv[1:]:
        namespace: dict[str, object] = {"__name__": "__main__"}
        for code in FENCE.findall((folder / f"{name}.md").read_text(encoding="utf-8")):
            exec(compile(code, f"{name}.md", "exec"), namespace)


if __name__ == "__main__":
    main()
