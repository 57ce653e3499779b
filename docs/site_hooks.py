"""What mkdocs calls while it builds the site: the search index once more as a script, and a look at every page."""

from __future__ import annotations

import html
import importlib.util
import re
from pathlib import Path
from typing import Any

RAW = {
    "a fence that is none": re.compile(r"<p>```"),
    "a bar with its backslash": re.compile(r"<code>[^<]*\\\|"),
    "an escape that is escaped": re.compile(r"&amp;(?:lt|gt|amp|#\d+);"),
    "a table that is none": re.compile(r"<p>\|"),
}
"""What a reader would see of the source, had Markdown not understood it."""


def broken(page: str) -> list[str]:
    """Return what is wrong with a built page.

    Examples
    --------
    >>> broken("<p>```python no-run x</p>"), broken("<p>fine</p>")
    (['a fence that is none'], [])
    """
    return [what for what, pattern in RAW.items() if pattern.search(page)]


def _typeset(text: str) -> str:
    """Return a formula as MathML; see ``formulas.py`` beside this file, which is no package."""
    spec = importlib.util.spec_from_file_location("formulas", Path(__file__).with_name("formulas.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return str(module.typeset(html.unescape(text)))


FORMULA = re.compile(r"(?<=law: )<code>(?P<law>[^<]*)</code>|<p>(?P<model>[^<]*[a-z]'[^<]* = [^<]*)</p>")


def on_page_content(text: str, page: Any, **more: Any) -> str:
    """Typeset laws of effects and equations of models."""
    if Path(page.file.src_uri).name not in ("effects.md", "models.md"):
        return text

    def set_one(found: re.Match[str]) -> str:
        return _typeset(found["law"]) if found["law"] is not None else f"<p>{_typeset(found['model'])}</p>"

    return FORMULA.sub(set_one, text)


def on_post_build(config: Any, **more: Any) -> None:
    """Write ``search/search_index.js`` and refuse pages that are broken."""
    from mkdocs.exceptions import PluginError

    site = Path(config["site_dir"])
    index = (site / "search" / "search_index.json").read_text(encoding="utf-8")
    (site / "search" / "search_index.js").write_text(f"window.searchIndex = {index};\n", encoding="utf-8")
    found = {
        str(path.relative_to(site)): faults
        for path in sorted(site.rglob("*.html"))
        if (faults := broken(path.read_text(encoding="utf-8")))
    }
    if found:
        raise PluginError("; ".join(f"{page}: {', '.join(faults)}" for page, faults in found.items()))


def on_nav(nav: Any, config: Any, files: Any) -> Any:
    """Refuse pages that no entry of the navigation leads to."""
    from mkdocs.exceptions import PluginError

    lost = [page.file.src_uri for page in (file.page for file in files.documentation_pages()) if page not in nav.pages]
    if lost:
        raise PluginError(f"pages that the navigation of mkdocs.yml does not lead to: {', '.join(lost)}")
    return nav
