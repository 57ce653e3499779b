"""Look at the built site in a real browser, from its files: every page, wide and narrow, light and dark.

Run: python docs/check_site.py SITE_FOLDER. Part of ``make docs``. Needs the extra dev (Playwright) and Chromium
(``apt-get install chromium``); without them it says so and leaves it at that. Ends with 1 if a page has a fault: an
error in its scripts, a picture that is not there, something wider than the window, a formula without a size, no copy
button on a block, a search that finds nothing, or a dark page that is not dark.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

LOOK = """() => {
  const faults = [];
  const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  if (wide > 1) faults.push(`${wide} pixels wider than the window`);
  for (const one of document.images)
    if (!one.complete || !one.naturalWidth) faults.push(`no picture ${one.getAttribute("src")}`);
  for (const one of document.querySelectorAll("math")) {
    const box = one.getBoundingClientRect();
    if (!(box.width > 3 && box.height > 3)) faults.push(`a formula without a size: ${one.textContent}`);
  }
  if ([...document.querySelectorAll("pre")].some((one) => !one.querySelector("button.copy")))
    faults.push("a block without a copy button");
  return faults;
}"""
DARK = "() => getComputedStyle(document.querySelector('.wy-nav-content') ?? document.body).backgroundColor"
THEIRS = "Failed to construct 'Worker'"
"""From a folder the theme's own search cannot begin; ours takes its place."""
SIZES = ((400, "dark"), (1400, "light"))
QUIET = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run")


def faults_of(page: Any, address: str, scheme: str) -> list[str]:
    """Return what is wrong with a page at the size that it has."""
    told: list[str] = []
    page.on("pageerror", lambda error: told.append(str(error)) if THEIRS not in str(error) else None)
    page.goto(address)
    found = [*told, *page.evaluate(LOOK)]
    if scheme == "dark":
        red, green, blue = (int(one) for one in page.evaluate(DARK).split("(")[1].rstrip(")").split(",")[:3])
        if red + green + blue > 240:
            found.append("light in the dark")
    return found


def searched(browser: Any, site: Path) -> list[str]:
    """Return what is wrong with the search, opened from the folder."""
    page = browser.new_page()
    page.goto(f"{(site / 'search.html').as_uri()}?q=coulomb")
    try:
        page.wait_for_selector("#mkdocs-search-results article a", timeout=10_000)
    except Exception as error:
        return [f"the search finds nothing: {str(error).splitlines()[0]}"]
    return []


def main() -> int:
    """Look at all pages; returns the exit status."""
    site = Path(sys.argv[1]).resolve()
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        program = None
    if program is None:
        print("the pages were not looked at in a browser: Playwright or Chromium is not installed", file=sys.stderr)
        return 0
    pages = sorted(path for path in site.rglob("*.html") if path.name != "404.html")  # that is for a server
    count = 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(QUIET))
        for width, scheme in SIZES:
            window = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
            for path in pages:
                page = window.new_page()
                for fault in faults_of(page, path.as_uri(), scheme):
                    print(f"{path.relative_to(site)} at {width} pixels, {scheme}: {fault}", file=sys.stderr)
                    count += 1
                page.close()
        for fault in searched(browser, site):
            print(fault, file=sys.stderr)
            count += 1
        browser.close()
    print(f"{len(pages)} pages looked at, wide and narrow, light and dark: {count} faults")
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
