"""The option that every identifier has which refuses what moves under a controller alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from harness.judgement import refuse_undetermined
from harness.signals import PlantSpec, Trajectory
from identifiers.common.records import learnable


@dataclass(frozen=True, kw_only=True)
class Excited:
    """What an identifier asks of the excitation of its records.

    Parameters
    ----------
    least_excitation : float
        0 fits also what moves under a controller alone (:mod:`harness.judgement`), from which no model can learn what
        the inputs do.
    """

    least_excitation: float = 2.0

    def asked(
        self, trajectories: Sequence[Trajectory], *, samples: int, what: str, inputs: bool = False
    ) -> tuple[list[Trajectory], PlantSpec]:
        """Return the records that can be learned from, in an order of their own, and their spec.

        Rows, windows and batches are drawn from them: in whatever order records come, they make the same model.

        Parameters
        ----------
        trajectories : sequence of Trajectory
        samples : int
            Least number of samples of a record.
        what : str
            Name of the identifier, for messages.
        inputs : bool
            Ask that every input moves.

        Raises
        ------
        FitError
            If there are none.
        """
        records, spec = learnable(trajectories, samples=samples, what=what, inputs=inputs)
        refuse_undetermined(records, what, self.least_excitation)
        return sorted(records, key=lambda record: (len(record), record.y.tobytes())), spec
