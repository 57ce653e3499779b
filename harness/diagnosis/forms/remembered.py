"""A form whose finished fits are kept by their content, so that an interrupted diagnosis continues where it stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.blackbox.recent import Recent
from harness.diagnosis.effort import EFFORT
from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.number import described
from harness.diagnosis.policy import DATA_POLICY, POLICY
from harness.diagnosis.search.fit import Begun, Column, Fit, InOneGo, Jump, Linearised, Suspect
from harness.diagnosis.store import CandidateStore, data_fingerprint
from harness.diagnosis.systems import AnySystem, Starts
from harness.effects.dictionary import Dictionary
from harness.effects.effect import Placed
from harness.fingerprint import fingerprint, own_code
from harness.signals import FloatArray


class Remembered(InOneGo):
    """Keeps finished fits; one that is asked for again is read back, whatever was asked before it.

    A fit is known by all that decides it: the data, the compiled model with its effects, where its first steps led, the
    fits that it goes on from and is held against, the deciding numbers and the code of the project.

    - ``folder``: nothing is kept without one
    """

    def __init__(self, form: WholeForm, folder: Path | None) -> None:
        self.form = form
        self.store: CandidateStore | None = None
        if folder is not None:
            decides = [described(numbers) for numbers in (POLICY, EFFORT, DATA_POLICY)]
            self.store = CandidateStore(folder, fingerprint(data_fingerprint(form.dataset), decides, own_code()))
        self.proposed: Callable[[], list[Suspect]] = list
        """What else is begun beside the nominal model, whatever a first-order test says."""

        self._anew: Recent[tuple[Any, ...], Fit | None] = Recent(8)

    @property
    def nominal(self) -> AnySystem:
        """See :class:`harness.diagnosis.search.fit.Form`, also below."""
        return self.form.nominal

    @property
    def laws(self) -> Dictionary:
        """Pass on."""
        return self.form.laws

    def begin(self, effects: Sequence[Placed], starts: Starts, base: Fit | None, hope: float = -np.inf) -> Begun | None:
        """Begin as it is asked for: first steps are cheap, and the same each time."""
        return self.form.begin(effects, starts, base, hope)

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit | None:
        """Finish a fit; one that was finished before is the same, and a failure is kept too."""
        if self.store is None:
            return self.form.finish(begun, base, rival, least)
        first = begun.system, begun.values, begun.log_likelihood
        key = fingerprint([*map(str, begun.effects)], first, _identity(base), _identity(rival), least)
        known = self.store.get(key)
        if known is not None:
            return self.form.restored(begun.effects, known) if known else None
        fit = self.form.finish(begun, base, rival, least)
        self.store.put(key, {} if fit is None else self.form.record(fit))
        return fit

    def anew(self, fit: Fit) -> Fit | None:
        """Return a model that was fitted to other records at its maximum for these, begun anew from its values.

        The last ones are kept, and a model that ended here is its own maximum.
        """
        names = frozenset(map(str, fit.effects))
        key = names, *sorted(fit.values.items())
        if key not in self._anew:
            found = self._anew[key] = self.fit(fit.effects, [fit.values], None)
            if found is not None:
                self._anew[names, *sorted(found.values.items())] = found
        return self._anew[key]

    def without_memory(self, fit: Fit) -> Fit | None:
        """Pass on."""
        return self.form.without_memory(fit)

    def linearised(self, fit: Fit) -> Linearised:
        """Pass on."""
        return self.form.linearised(fit)

    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        """Pass on."""
        return self.form.columns(fit, candidates)

    def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
        """Pass on, with what is proposed beside the nominal model."""
        known = {str(placed) for placed in candidates}
        more = [] if base.effects else [suspect for suspect in self.proposed() if str(suspect.placed) in known]
        return [*self.form.suspects(base, rival, candidates), *more]

    def test_functions(self, fit: Fit) -> list[Column]:
        """Pass on."""
        return self.form.test_functions(fit)

    def left_out(self) -> list[str]:
        """Pass on."""
        return self.form.left_out()

    def limited(self) -> bool:
        """Pass on."""
        return self.form.limited()

    def change(self, fit: Fit, placed: Placed) -> float:
        """Pass on."""
        return self.form.change(fit, placed)

    def distance(self, fit: Fit, other: Fit) -> float:
        """Pass on."""
        return self.form.distance(fit, other)

    def jumps(self, fit: Fit) -> list[Jump]:
        """Pass on."""
        return self.form.jumps(fit)

    def damping(self, fit: Fit, at: str) -> tuple[FloatArray, FloatArray] | None:
        """Pass on."""
        return self.form.damping(fit, at)


def _identity(fit: Fit | None) -> tuple[Any, ...] | None:
    """Return what tells a fit from any other of the same data."""
    if fit is None:
        return None
    return [*map(str, fit.effects)], fit.values, [fit.log_likelihood(use) for use in sorted(fit.terms)]
