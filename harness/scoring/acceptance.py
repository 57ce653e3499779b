"""What a result has to fulfil, said by who runs it: verdicts that fail, errors that are too large; for CI."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from harness.errors import InputError, refuse_unknown
from harness.units import behind, convert, told

VERDICTS = ("effects_found", "nothing_missing", "unexplained", "model_does_not_fit")
"""What ``verdict`` of report.json may say (harness/schemas/report.json)."""
STATUSES = ("refused", "unfit", "failed", "diverged", "crashed", "timeout", "terminated")
"""What a record of a fleet may end with that has no verdict (harness.errors)."""
_QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")


@dataclass(frozen=True)
class Demand:
    """One demand on one result.

    Parameters
    ----------
    subject : str
        What was judged: a record, a model.
    name : str
        The demand.
    passed : bool
    text : str
        What came, against what was demanded.
    broken : bool
        True where there was no result to judge: data that were refused, a crash.
    """

    subject: str
    name: str
    passed: bool
    text: str = ""
    broken: bool = False


@dataclass(frozen=True)
class Demands:
    """What fails a result.

    Parameters
    ----------
    fail_on : tuple of str
        Verdicts of a closed loop (:data:`VERDICTS`); of a fleet also how a record may end (:data:`STATUSES`).
    max_error : mapping
        By output: the largest rms of the simulation error on validation data, a number with its unit (``"2 mrad"``).
        The model is the repaired one, where effects were found.
    max_share : float, optional
        Largest share of the validation motion's variance that the model may leave unexplained.

    Raises
    ------
    InputError
        If a verdict is unknown, an error is no quantity, or the share is none.

    Examples
    --------
    >>> demands = Demands(("unexplained",), {"theta": "2 mrad"})
    >>> [check.passed for check in demands.of_errors("run", {"theta": (0.001, "rad")})]
    [True]
    """

    fail_on: tuple[str, ...] = ()
    max_error: Mapping[str, str] | None = None
    max_share: float | None = None

    def __post_init__(self) -> None:
        refuse_unknown(
            "verdict that fails", self.fail_on, (*VERDICTS, *STATUSES), remedy="correct it", place="--fail-on"
        )
        for output, text in (self.max_error or {}).items():
            _quantity(output, text)
        if self.max_share is not None and not 0.0 <= self.max_share <= 1.0:
            raise InputError(
                "largest unexplained share",
                expected="a number from 0 to 1",
                got=f"{self.max_share:g}",
                remedy="correct it",
                place="--max-share",
            )

    @property
    def anything(self) -> bool:
        """True if something is demanded."""
        return bool(self.fail_on or self.max_error or self.max_share is not None)

    def of_report(self, subject: str, data: Mapping[str, Any]) -> list[Demand]:
        """Return the checks of a report of the closed loop (the content of ``report.json``)."""
        found = []
        if self.fail_on:
            verdict = str(data["verdict"])
            found.append(Demand(subject, "verdict", verdict not in self.fail_on, verdict.replace("_", " ")))
        if self.max_error:
            told = data["errors"]["after"].get("simulation_error", {}).get("validation", {})
            errors = {name: (score.get("rms"), str(score.get("unit", "1"))) for name, score in told.items()}
            found += self.of_errors(subject, errors)
        if self.max_share is not None:
            share = data.get("explained_share")
            left = math.inf if share is None else 1.0 - float(share)
            text = f"{left:.3g} of the motion is unexplained, at most {self.max_share:g} may be"
            found.append(Demand(subject, "max-share", left <= self.max_share, text))
        return found

    def of_errors(self, subject: str, errors: Mapping[str, tuple[float | None, str]]) -> list[Demand]:
        """Return the checks of errors (rms, unit) by output.

        Raises
        ------
        InputError
            If there is no such output, or the unit is another quantity.
        """
        found = []
        refuse_unknown("largest error of an unknown output", self.max_error or (), errors, place="--max-error")
        for output, text in (self.max_error or {}).items():
            value, unit = errors[output]
            number, stated = _quantity(output, text)
            limit = number
            if (stated or "1") != unit:
                if not stated:
                    raise InputError(
                        f"largest error of {output}",
                        expected=f"a number with its unit, such as {output}={number:g}{unit}",
                        got=repr(text),
                        remedy="write the unit",
                        place="--max-error",
                    )
                try:
                    zero, limit = convert(np.array([0.0, number]), stated, unit).tolist()
                except InputError as error:
                    raise error.located(place=f"--max-error {output}") from error
                limit -= zero  # an error is a difference: 2 degC are 2 K
            said = "diverges"
            if value is not None and math.isfinite(value):
                size, own = told(value, unit, stated or unit)
                said = f"{size:.4g}{behind(own)}"
            passed = value is not None and value <= limit
            found.append(
                Demand(
                    subject, f"max-error {output}", passed, f"{output} simulation error {said}, at most {text} allowed"
                )
            )
        return found


def _quantity(output: str, text: str) -> tuple[float, str]:
    """Return number and unit of ``2 mrad``."""
    match = _QUANTITY.match(str(text))
    if match is None or float(match[1]) < 0:
        raise InputError(
            f"largest error of {output}",
            expected="a number that is not negative, with its unit, such as 2mrad",
            got=repr(text),
            remedy="correct it",
            place="--max-error",
        )
    return float(match[1]), match[2]


def write_junit(path: str | Path, suite: str, checks: Sequence[Demand]) -> None:
    """Write checks as JUnit XML, which CI services show: a test case each.

    Parameters
    ----------
    path : path
        An existing file is replaced, whole or not at all.
    suite : str
        Name of the suite: the command.
    checks : sequence of Check
    """
    from harness.data.whole_files import whole_file

    failed = sum(not check.passed and not check.broken for check in checks)
    broken = sum(check.broken for check in checks)
    counts = {"tests": str(len(checks)), "failures": str(failed), "errors": str(broken)}
    root = ElementTree.Element("testsuites", counts)
    group = ElementTree.SubElement(root, "testsuite", {"name": suite, **counts})
    for check in checks:
        case = ElementTree.SubElement(group, "testcase", {"classname": f"{suite}.{check.subject}", "name": check.name})
        text = "".join(letter if letter.isprintable() else " " for letter in check.text)
        if check.broken:
            ElementTree.SubElement(case, "error", {"message": text})
        elif not check.passed:
            ElementTree.SubElement(case, "failure", {"message": text})
        elif text:
            ElementTree.SubElement(case, "system-out").text = text
    ElementTree.indent(root)
    with whole_file(Path(path)) as scratch:
        scratch.write_text(
            '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n",
            encoding="utf-8",
        )
