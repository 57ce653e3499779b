"""What was tried on an FMU and what came of it, as lines, rows, JSON and a page."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

from harness.errors import printable
from harness.scoring.acceptance import Demand
from harness.signals import Trajectory

WORDS = {True: "ok", False: "FAIL", None: "-"}


@dataclass(frozen=True)
class Finding:
    """One check.

    Parameters
    ----------
    name : str
    passed : bool or None
        None where there is nothing to pass: a fact, or something that the FMU does not offer.
    tried : str
        What was done.
    came : str
        What came of it.
    figure : float, optional
        The number behind it.
    """

    name: str
    passed: bool | None
    tried: str
    came: str
    figure: float | None = None


@dataclass(frozen=True, eq=False)
class Vetting:
    """All that was found about an FMU; ``record`` is the run under changing inputs, if there was one."""

    file: Path
    title: str
    findings: tuple[Finding, ...]
    record: Trajectory | None = None

    @property
    def passed(self) -> bool:
        """True if nothing failed."""
        return all(finding.passed is not False for finding in self.findings)

    def checks(self) -> list[Demand]:
        """Return the findings as a command judges them."""
        return [
            Demand(self.file.name, one.name, one.passed is not False, f"{one.tried}: {one.came}")
            for one in self.findings
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return everything, ready for JSON."""
        return {
            "file": str(self.file),
            "title": self.title,
            "passed": self.passed,
            "findings": [asdict(finding) for finding in self.findings],
        }

    def __str__(self) -> str:
        lines = [printable(self.title)]
        lines += [
            f"{WORDS[one.passed]:<5}{one.name:<20} {printable(one.tried)}: {printable(one.came)}"
            for one in self.findings
        ]
        return "\n".join([*lines, self.summary])

    @property
    def summary(self) -> str:
        """How many checks passed and failed, in words."""
        failed = sum(one.passed is False for one in self.findings)
        passed = sum(one.passed is True for one in self.findings)
        return f"{passed} passed, {failed} failed, {len(self.findings) - passed - failed} to know"

    def _repr_html_(self) -> str:
        return self._parts()

    def html(self) -> str:
        """Return a page by itself."""
        from harness.display import STYLE

        return (
            f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(self.file.name)}</title>'
            f'<meta name="viewport" content="width=device-width"><style>{STYLE}'
            "td{vertical-align:top;border-top:1px solid #8884}td:last-child{overflow-wrap:anywhere}"
            "tr.FAIL td:first-child{color:#cc3311;font-weight:bold}"
            f"</style></head><body><h1>{escape(printable(self.file.name))}</h1>{self._parts()}</body></html>\n"
        )

    def _parts(self) -> str:
        """Return the title, the table and the picture."""
        from harness.display import page

        rows = "".join(
            f'<tr class="{WORDS[one.passed]}">'
            + "".join(
                f"<td>{escape(printable(cell))}</td>" for cell in (WORDS[one.passed], one.name, one.tried, one.came)
            )
            + "</tr>"
            for one in self.findings
        )
        head = "".join(f"<th>{title}</th>" for title in ("", "check", "what was tried", "what came"))
        parts = [f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"]
        if self.record is not None and 0 < self.record.spec.ny + self.record.spec.nu <= SHOWN:
            from harness.plots import inlined

            parts.append(inlined(self.record.plot(), "the run under changing inputs"))
        return page(f"{self.title}: {self.summary}", *parts)


SHOWN = 24  # Signals beyond which no picture is drawn: nobody would read it.
