"""A form whose finished fits are kept, so that an interrupted diagnosis continues where it stopped."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from harness.diagnosis.forms.form import WholeForm
from harness.diagnosis.search.fit import Begun, Column, Fit, Linearised, Suspect
from harness.diagnosis.store import Store, fingerprint
from harness.diagnosis.systems import AnySystem
from harness.effects.effect import Placed

__all__ = ["Remembered"]


class Remembered:
    """Keeps finished fits; one that is asked for again, in the same order of things, is read back.

    Parameters
    ----------
    form : WholeForm
    folder : Path, optional
        Nothing is kept without one.
    """

    def __init__(self, form: WholeForm, folder: Path | None) -> None:
        self.form = form
        system = form.nominal
        identity = fingerprint(form.dataset, model=str(system), parameters=str(system.parameters))
        self.store = Store(folder, identity)
        self._number: dict[str, int] = {}
        self.proposed: Callable[[], list[Suspect]] = list
        """What else is begun beside the nominal model, whatever a first-order test says."""

    @property
    def nominal(self) -> AnySystem:
        """See :class:`harness.diagnosis.search.fit.Form`, also below."""
        return self.form.nominal

    def begin(
        self,
        effects: Sequence[Placed],
        starts: Sequence[Mapping[str, float]],
        base: Fit | None,
        hope: float = -np.inf,
    ) -> Begun | None:
        """Begin as it is asked for: first steps are cheap, and the same each time."""
        return self.form.begin(effects, starts, base, hope)

    def finish(self, begun: Begun, base: Fit | None, rival: Fit | None = None, least: float = -np.inf) -> Fit | None:
        """Finish a fit; one that was finished before is the same, and a failure is kept too."""
        name = " + ".join(sorted(map(str, begun.effects))) or "nominal"
        self._number[name] = self._number.get(name, 0) + 1
        key = f"{name}#{self._number[name]}"
        known = self.store.get(key)
        if known is not None:
            return self.form.restored(begun.effects, known) if known else None
        fit = self.form.finish(begun, base, rival, least)
        self.store.put(key, {} if fit is None else self.form.record(fit))
        return fit

    def fit(
        self,
        effects: Sequence[Placed],
        starts: Sequence[Mapping[str, float]],
        base: Fit | None,
        rival: Fit | None = None,
    ) -> Fit | None:
        """Begin and finish."""
        begun = self.begin(effects, starts, base)
        return None if begun is None else self.finish(begun, base, rival)

    def forgetful(self, fit: Fit) -> Fit | None:
        """Pass on."""
        return self.form.forgetful(fit)

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
