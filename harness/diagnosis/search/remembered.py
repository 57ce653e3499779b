"""A form whose finished fits are kept, so that an interrupted diagnosis continues where it stopped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.diagnosis.search.fit import Begun, Column, Fit, Linearised, Suspect
from harness.diagnosis.search.likelihood_form import LikelihoodForm
from harness.diagnosis.store import Store, fingerprint
from harness.effects.effect import Placed

__all__ = ["Remembered"]


class Remembered:
    """Keeps where fits ended; one that is asked for again starts there, and is done after a step or two.

    Parameters
    ----------
    form : LikelihoodForm
    folder : Path, optional
        Nothing is kept without one.
    """

    def __init__(self, form: LikelihoodForm, folder: Path | None) -> None:
        self.form = form
        system = form.nominal
        identity = fingerprint(form.dataset, model=str(system), parameters=str(system.parameters))
        self.store = Store(folder, identity)
        self._number: dict[str, int] = {}

    @property
    def nominal(self) -> Any:
        """See :class:`harness.diagnosis.search.fit.Form`, also below."""
        return self.form.nominal

    def begin(self, effects: Sequence[Placed], starts: Sequence[Mapping[str, float]], base: Fit | None) -> Begun | None:
        """Begin where the same fit ended before, else where it is asked for; failures are kept too."""
        key = self._key("begin", effects)
        known = self.store.get(key)
        if known is not None:
            return self.form.begin(effects, [known["values"]], base) if known["values"] else None
        begun = self.form.begin(effects, starts, base)
        self.store.put(key, {"values": None if begun is None else begun.values})
        return begun

    def finish(self, begun: Begun, base: Fit | None) -> Fit | None:
        """Finish a fit, from where it ended before if it did."""
        key = self._key("finish", begun.effects)
        known = self.store.get(key)
        if known is not None and known["values"]:
            return self.form.fit(begun.effects, [known["values"]], base)
        found = self.form.finish(begun, base)
        self.store.put(key, {"values": None if found is None else found.values})
        return found

    def fit(self, effects: Sequence[Placed], starts: Sequence[Mapping[str, float]], base: Fit | None) -> Fit | None:
        """Begin and finish."""
        begun = self.begin(effects, starts, base)
        return None if begun is None else self.finish(begun, base)

    def _key(self, stage: str, effects: Sequence[Placed]) -> str:
        """Return the name of a fit: the order in which the same one is asked for is always the same."""
        name = f"{stage} {' + '.join(sorted(map(str, effects))) or 'nominal'}"
        self._number[name] = self._number.get(name, 0) + 1
        return f"{name}#{self._number[name]}"

    def linearised(self, fit: Fit) -> Linearised:
        """Pass on."""
        return self.form.linearised(fit)

    def columns(self, fit: Fit, candidates: Sequence[Placed]) -> list[Column]:
        """Pass on."""
        return self.form.columns(fit, candidates)

    def suspects(self, base: Fit, rival: Begun | None, candidates: Sequence[Placed]) -> list[Suspect]:
        """Pass on."""
        return self.form.suspects(base, rival, candidates)

    def test_functions(self, fit: Fit) -> list[Column]:
        """Pass on."""
        return self.form.test_functions(fit)
