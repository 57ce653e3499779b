"""Which physical model a record speaks of: a model by name, its measured outputs, the effects built into it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from harness.errors import FitError, HarnessError, InputError
from harness.signals import PlantSpec, Trajectory
from identifiers.common.records import learnable

if TYPE_CHECKING:
    from harness.physics import System
    from harness.physics.fitting.residual_force import ResidualForce


@dataclass(frozen=True)
class Recipe:
    """What a grey box is made of, in words that a file can hold."""

    model: str  # A built-in model (``"cart-pole"``) or ``FILE.py:NAME``
    options: Mapping[str, Any] = field(default_factory=dict)
    """For the model's function (``{"order": 3}`` of ``linear``)."""
    outputs: tuple[tuple[str, int], ...] = ()  # tuple of (str, int): Ports measured and which derivative of each
    effects: tuple[str, ...] = ()  # ``"coulomb_friction@theta"``
    unnamed: tuple[ResidualForce, ...] = ()  # Forces without a name, added last

    def with_unnamed(self, forces: Sequence[ResidualForce]) -> Recipe:
        """Return the recipe with forces without a name added (see :mod:`harness.physics.fitting.residual_force`)."""
        return replace(self, unnamed=(*self.unnamed, *forces))

    def system(self, spec: PlantSpec) -> System:
        """Return the system that speaks like a spec.

        Raises
        ------
        InputError
            If the model, a port or an effect is unknown.
        """
        from harness.effects import Placed, compose, find
        from harness.physics import load_model

        system = load_model(self.model, **dict(self.options))
        names = [channel.name for channel in spec.outputs]
        plain = [channel.name for channel in system.outputs]
        if self.outputs and (plain != names or any(order for _, order in self.outputs)):
            chosen = [(port, order, name) for (port, order), name in zip(self.outputs, names, strict=True)]
            system = system.with_outputs(chosen)
        placed = []
        for text in self.effects:
            name, _, at = text.partition("@")
            if not at:
                raise InputError(
                    "effect of a grey box", expected="NAME@PORT", got=repr(text), remedy="write coulomb_friction@theta"
                )
            placed.append(Placed(find(name), at))
        system = compose(system, placed) if placed else system
        for force in self.unnamed:
            system = force.attach(system)
        return system

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description."""
        return {
            "model": self.model,
            "options": dict(self.options),
            "effects": [text.split("@", 1) for text in self.effects],
            **({"unnamed_forces": [force.to_dict() for force in self.unnamed]} if self.unnamed else {}),
        }


@dataclass(frozen=True)
class PhysicalFit:
    """What every fit of a physical model to records is told; abstract.

    Parameters
    ----------
    model : str, optional
        A built-in model or ``FILE.py:NAME``; by default the built-in one with the signals of the records.
    options : mapping
        For the model's function.
    effects : tuple of str
        Effects that the model has too: ``("coulomb_friction@theta",)``.
    fixed : tuple of str
        Parameters that keep their value.
    start : mapping
        Values where some parameters start.
    """

    model: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    effects: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    start: Mapping[str, float] = field(default_factory=dict)

    def prepared(
        self, trajectories: Sequence[Trajectory], what: str
    ) -> tuple[list[Trajectory], PlantSpec, Recipe, System]:
        """Return the records that can be used, their spec, and the model that speaks like them.

        Raises
        ------
        FitError
            If there is nothing to learn from, or no model speaks like the records.
        """
        records, spec = learnable(trajectories, samples=10, what=what, inputs=False, holes="kept")
        recipe = recipe_for(spec, what, model=self.model, options=self.options, effects=tuple(self.effects))
        system = recipe.system(spec)
        return records, spec, recipe, system


def recipe_for(
    spec: PlantSpec,
    what: str,
    *,
    model: str | None = None,
    options: Mapping[str, Any] | None = None,
    effects: Sequence[str] = (),
) -> Recipe:
    """Return the recipe of a model for records of a spec.

    Raises FitError if no built-in model fits, or two do, or the given one does not.

    - ``what``: name of the identifier, for messages
    - ``model``: by default the built-in model whose inputs and outputs (or their rates) are those of the spec, by name
      and unit
    - ``options``: for the model's function
    - ``effects``: ``NAME@PORT``

    Examples
    --------
    >>> from harness.signals import Channel
    >>> spec = PlantSpec((Channel("u", "N m"),), (Channel("theta", "rad"), Channel("theta_rate", "rad/s")), 0.01)
    >>> recipe_for(spec, "output-error").outputs
    (('theta', 0), ('theta', 1))
    """
    from harness.physics import load_model
    from harness.physics.models import BUILT_IN

    given = dict(options or {})
    if model is not None:
        if model == "linear" and not {"inputs", "outputs"} & set(given):
            given |= {"inputs": [c.name for c in spec.inputs], "outputs": [c.name for c in spec.outputs]}
        try:
            system = load_model(model, **given)
        except InputError as error:
            raise FitError(
                f"{what}: {error.what}", expected=error.expected, got=error.got, remedy=error.remedy
            ) from error
        outputs = _measured(system, spec)
        if outputs is None:
            raise FitError(
                f"{what}: the records do not speak the language of {model}",
                expected=str(system),
                got=str(spec),
                remedy="rename the signals, or choose another model",
            )
        return Recipe(model, given, outputs, tuple(effects))
    found = []
    for name in BUILT_IN:
        if name == "linear":
            continue
        outputs = _measured(load_model(name), spec, units=True)
        if outputs is not None:
            found.append(Recipe(name, {}, outputs, tuple(effects)))
    if len(found) != 1:
        names = " or ".join(recipe.model for recipe in found)
        raise FitError(
            f"{what}: {'two models fit' if found else 'no built-in model has these signals'}",
            expected="the signals of one built-in model (sysid list models)",
            got=f"{spec}" + (f" ({names})" if found else ""),
            remedy="give model=NAME or model=FILE.py:NAME",
        )
    return found[0]


def _measured(system: System, spec: PlantSpec, *, units: bool = False) -> tuple[tuple[str, int], ...] | None:
    """Return port and derivative of each output of a spec; None if the system does not have it."""
    if [c.name for c in system.inputs] != [c.name for c in spec.inputs]:
        return None
    if units and [c.unit for c in system.inputs] != [c.unit for c in spec.inputs]:
        return None
    own = {c.name: c.unit for c in (*system.states, *system.outputs)}
    orders = {"_rate": 1, "_dot": 1, "_acceleration": 2}
    derived = {f"{c.name}{suffix}": (c.name, order) for c in system.outputs for suffix, order in orders.items()}
    chosen: list[tuple[str, int]] = []
    for channel in spec.outputs:
        port, order = derived.get(channel.name, (channel.name, 0))
        if port not in own or (units and not order and own[port] != channel.unit):
            return None
        chosen.append((port, order))
    if len(set(chosen)) != len(chosen):
        return None
    if units and not {c.name for c in system.outputs} <= {port for port, order in chosen if order == 0}:
        return None
    try:
        system.with_outputs([(port, order, c.name) for (port, order), c in zip(chosen, spec.outputs, strict=True)])
    except HarnessError:
        return None
    return tuple(chosen)
