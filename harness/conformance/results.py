"""What a check is, what it answers, and how a list of checks is run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from harness.errors import HarnessError
from harness.supervision.guarded import alive


class Broken(AssertionError):
    """The contract is broken; the text says how."""


class NotApplicable(Exception):
    """The check has nothing to look at in this part; the text says why."""


@dataclass(frozen=True)
class CheckResult:
    """The outcome of one named check.

    Parameters
    ----------
    name : str
        Name of the check.
    passed : bool
        True too where the check does not apply, or fails as declared.
    reason : str
        Why it failed, why it does not apply, or empty.
    """

    name: str
    passed: bool
    reason: str = ""


@dataclass(frozen=True)
class Check:
    """One named demand of a contract.

    Call it with a factory (a callable without arguments that returns a fresh part): it returns nothing, or raises
    :class:`Broken` (an ``AssertionError``), so a list of checks is a parametrized pytest::

        @pytest.mark.parametrize("check", identifier_checks(), ids=str)
        def test_contract(check):
            check(MyIdentifier)
    """

    name: str
    about: str
    body: Callable[[Callable[[], Any]], None]

    def __call__(self, factory: Callable[[], Any]) -> None:
        """Hold the parts of a factory to this demand; a failure that the part declares must be one."""
        result = run_checks([self], factory)[-1]
        if not result.passed:
            raise Broken(result.reason)

    def __str__(self) -> str:
        return self.name


def demand(condition: object, reason: str) -> None:
    """Raise :class:`Broken` with a reason unless the condition holds."""
    if not condition:
        raise Broken(reason)


def run_checks(
    checks: Sequence[Check],
    factory: Callable[[], Any],
    *,
    expected_failures: Mapping[str, str] | None = None,
) -> list[CheckResult]:
    """Run every check and never raise for a part that breaks its contract.

    Parameters
    ----------
    checks : sequence of Check
    factory : callable
        Returns a fresh part each time.
    expected_failures : mapping, optional
        Name of a check to the reason why it is known to fail. Strict: a declared failure that passes is a failure.
        A part may declare its own as the class attribute ``expected_failures``, the way a baseline says that no input
        matters to it.

    Returns
    -------
    list of CheckResult
        One for each check, in order.

    Examples
    --------
    >>> def fails(factory):
    ...     demand(factory() == 2, "expected 2")
    >>> run_checks([Check("two", "is it two", fails)], lambda: 1, expected_failures={"two": "it is one"})
    [CheckResult(name='two', passed=True, reason='fails as declared (it is one): expected 2')]
    """
    given = dict(expected_failures or {})
    declared = {**_declared(factory), **given}
    unknown = sorted(set(given) - {check.name for check in checks})
    results = [
        CheckResult(name, False, "declared to fail, and no check has this name: remove the declaration")
        for name in unknown
    ]
    for check in checks:
        alive()
        try:
            check.body(factory)
            broken = ""
        except NotApplicable as error:
            results.append(CheckResult(check.name, True, f"does not apply: {_line(error)}"))
            continue
        except Broken as error:
            broken = _line(error)
        except HarnessError as error:
            broken = f"refused: {_line(error)}"
        except Exception as error:
            broken = f"raised {type(error).__name__}: {_line(error)}"
        excuse = declared.get(check.name)
        if excuse is None:
            results.append(CheckResult(check.name, not broken, broken))
        elif broken:
            results.append(CheckResult(check.name, True, f"fails as declared ({excuse}): {broken}"))
        else:
            results.append(CheckResult(check.name, False, f"declared to fail ({excuse}), and passes: remove that"))
    return results


def _declared(factory: Callable[[], Any]) -> dict[str, str]:
    """Return what a part says of itself that it does not keep, and why."""
    found = getattr(factory, "expected_failures", None)
    if found is None and not isinstance(factory, type):
        try:
            made = factory()
        except Exception:
            return {}  # the checks will say what is wrong with it
        found = getattr(made, "expected_failures", None)
        close = getattr(made, "close", None)
        if callable(close):
            close()
    return dict(found) if isinstance(found, Mapping) else {}


def _line(error: BaseException) -> str:
    """Return the text of an error on one line of bounded length."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    text = " ".join(" ".join(lines).split())
    return text if len(text) <= 400 else text[:397] + "..."
