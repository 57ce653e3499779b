"""Run every command and block of docs/chapter.md, and look for each figure of its sentences in what they printed.

Run ``python docs/check_chapter.py`` (some minutes). A figure counts as printed if a number that a block of its section
printed, or was given, rounds to it, in its own unit, in thousandths or in percent. What was printed nowhere is listed,
but for the figures of :data:`ELSEWHERE`, which are the chapter's own or come from the script or test that is named.
Exit status 1: a command failed, or a figure is not what was printed.
"""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

PAGE = Path(__file__).parent / "chapter.md"
FENCE = re.compile(r"^```(?P<kind>[^\n`]*)\n(?P<text>.*?)^```\s*$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"(?<![\w.\]^])-?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w^]*[\])])(?!\w)")
UNITS = (1.0, 1e3, 1e-3, 1e2)
"""As printed, in thousandths, in thousands, in percent."""

ELSEWHERE = {
    **dict.fromkeys(
        ("0.211", "-0.530", "0.03", "10.90542535", "0.59457971", "0.30291575"), "docs/mechanical_figures.py"
    ),
    **dict.fromkeys(("63831", "2.55"), "docs/glider_figures.py"),
    **dict.fromkeys(("0.008", "0.015"), "docs/learning-control.md, whose blocks run in the tests"),
    **dict.fromkeys(("3.76", "4.38", "32000"), "another's re-run of the chapter's example"),
    "1e-12": "tests of the regressor",
    "1.01": "the command of the sentence, half a minute",
    "0.14": "from the upright to the starts that the command is given",
    "0.9": "18 seeds",
    **dict.fromkeys(("2.6", "0.02"), "docs/modes.md, whose commands run in the tests"),
    **dict.fromkeys(("1.3e-5", "1.9e-3"), "25 simulated records of the chapter's data"),
    **dict.fromkeys(
        ("5.313e-7", "0.016846", "0.036672"),
        "tests/identifiers/test_identifiers_systems_linear.py, which the text names",
    ),
}
"""Figures that no block above prints: where each comes from."""


def sections(page: str) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    r"""Yield the sentences of every section, and its blocks ("sh" | "python", content), in the order of the page.

    Examples
    --------
    >>> list(sections("## A\n\n```sh\necho 1\n```\n\nb\n"))[1]
    ('## A\n\n\nb\n', [('sh', 'echo 1\n')])
    """
    blocks = {match.start(): match for match in FENCE.finditer(page)}
    starts = [0, *(m.start() for m in re.finditer(r"^##+ ", page, re.MULTILINE)), len(page)]
    for first, last in itertools.pairwise(starts):
        own = [(match["kind"].strip(), match["text"]) for at, match in blocks.items() if first <= at < last]
        yield FENCE.sub("", page[first:last]), own


def figures(text: str) -> list[str]:
    """Return the figures of sentences that a measurement gives: decimals, and whole numbers of three digits and more.

    Examples
    --------
    >>> figures("With 5 % of noise it errs by 0.198 and 77 samples, 1500 `-O x=0.3` ([a](b.md#c-0.5)).")
    ['0.198', '1500']
    """
    plain = re.sub(r"`[^`]*`|!?\[[^\]]*\]\([^)]*\)|^#.*$|^!.*$|\((?:true|asked)[^)]*\)", " ", text, flags=re.MULTILINE)
    found = NUMBER.findall(plain)
    return [one for one in found if "." in one or (len(one) > 2 and not 1900 <= int(float(one)) <= 2100)]


def printed(figure: str, outputs: str) -> bool:
    """Return whether a number of the outputs rounds to a figure.

    Examples
    --------
    >>> printed("0.198", "rms 0.19841"), printed("4.1", "0.00411 rad"), printed("0.2", "0.31")
    (True, True, False)
    """
    digits = len(figure.partition(".")[2].partition("e")[0])
    size, exponent = float(figure), int(figure.partition("e")[2] or 0)
    half = 0.5000001 * 10.0 ** (exponent - digits)
    values = [abs(float(one)) for one in re.findall(r"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", outputs)]
    return any(abs(value * unit - abs(size)) <= half for value in values for unit in UNITS)


def main() -> int:
    """Run the page and list what does not hold."""
    program, wrong = "", 0
    with tempfile.TemporaryDirectory() as folder:
        for text, blocks in sections(PAGE.read_text(encoding="utf-8")):
            outputs = ""
            for kind, block in blocks:
                program = (program if "# continues" in block else "") + block if kind == "python" else program
                run = [sys.executable, "-c", program] if kind == "python" else ["sh", "-e", "-c", block]
                done = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=False)
                outputs += done.stdout + done.stderr + block
                if done.returncode:
                    wrong += 1
                    print(f"exit status {done.returncode}: {block[:200]}\n{done.stderr[-500:]}")
            title = text.strip().partition("\n")[0].strip("# ")
            missing = [one for one in figures(text) if one not in ELSEWHERE and not printed(one, outputs)]
            wrong += len(missing)
            if missing:
                print(f"{title}: printed nowhere: {', '.join(missing)}")
    print("every command runs, every figure is what was printed" if not wrong else f"{wrong} do not hold")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
