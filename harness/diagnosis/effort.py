"""What the closed loop spends: every number of cost, with its reason. None of them decides what is found."""

from __future__ import annotations

from dataclasses import dataclass

from harness.diagnosis.number import number


@dataclass(frozen=True)
class Effort:
    """How far the search looks: what is tried, and never how a comparison is decided."""

    starts: int = number(
        3,
        "choices of an effect's nonlinear parameters that a refit starts from",
        "the first-order promise does not order them: a Stribeck speed ten times off promised more than the true one",
        "tests",
    )
    faintest: float = number(
        0.02,
        "share of the best promise below which a refit is not begun in a round; the next round asks again",
        "what was accepted promised 0.08 of the best at least, and gained 44 times its promise at most",
        "judged records from 150000, which judge no more",
    )
    faint: int = number(
        4,
        "refits that are begun along columns which the nominal parameters take up nearly whole",
        "their promises are uncertain: a second viscous friction promised 150 and had nothing to give",
        "tests",
    )
    memory: float = number(
        0.05,
        "share of a record over which a latent force may remember; beyond it, promises are also asked for without",
        "a force of 0.2 of the record hid a constant force that was 19 better in log-likelihood, and promised 1.7",
    )
    begun: int = number(
        16, "refits that are begun in a round", "cost", "the overflow of measured tanks was the 13th by its promise"
    )
    refits: int = number(6, "refits that are finished in a round", "cost", "seeds below 1000")
    pairs: int = number(2, "rivals of a first answer that are tried with a second effect", "cost", "seeds below 1000")
    points: int = number(3, "starts of a fit that its first steps are taken from, the likeliest ones", "cost")
    parts: tuple[float, ...] = number(
        (0.5, 0.25, 0.1, 0.03),
        "of the way from a base to a start that is worse, where a likelier start is looked for",
        "steps of first order are right at a short way",
    )
    awake: float = number(
        0.01,
        "share of its declared value at which a positive parameter that has vanished starts again",
        "two steps of a fit through logarithms, of a factor of 7 at most, lead from there to half of what is declared",
        "a cart-pole whose friction was gone where a lag was missing",
    )
    looks: int = number(
        2,
        "of these, iterations before starts are left whose further ones would not bring them to the best one",
        "cost",
    )
    first_steps: int = number(5, "iterations from each of several starts before the best goes on", "cost", "tests")
    roughly: float = number(
        1e-3,
        "relative decrease of the cost at which a fit that is only ranked, or a start, has come far enough",
        "cost",
    )
    windows: int = number(
        12,
        "short windows of which an FMU's parameters are first fitted: every one costs a run a parameter and state",
        "cost; 40 of them took 30 s of CPU of a geared drive",
    )
    seconds: float = number(
        12.0,
        "CPU time [s] of an FMU's runs after which the search begins no more fits around it, and says what it did not "
        "try",
        "cost: a fifth of the minute that a loop around an FMU may take; what promises most is begun first",
        "a dead zone and a lag of a drivetrain at 17 ms a run: 8 and 3 rivals were begun, the true one first",
    )
    ending: float = number(
        28.0,
        "and after which it finishes none that was begun",
        "cost: more than as much again, so that what was begun first, and led, comes to its end",
        "a saturation that led by 3000 was left unfinished, as beginning its rivals had cost all there was",
    )
    dear: float = number(
        0.5,
        "CPU time [s] of an FMU's runs in the first steps of a fit from which on only the likeliest goes on to its end",
        "cost: two ends of a drivetrain's fit took 14 s each and were the same to 0.04 in log-likelihood",
    )
    exchanges: int = number(
        16,
        "times in a sample that dry friction around an FMU is told, at most",
        "its error falls with their power of 1.5: 40, 5.1 and 2.2 mrad of a pendulum at 1, 4 and 8",
        "tests",
    )
    onward: int = number(
        3,
        "times that a start takes as many steps again while each gains enough to come to what is hoped for",
        "an end stop began 116 below the base in log-likelihood and gained 68 with every step; flanks that only push "
        "began below a play and ended 1000 above it",
        "judged records from 230000, which judge no more",
    )
    proposed: int = number(
        4,
        "output-error fits with one effect, the nearest ones, that the search begins whatever the score test promises",
        "cost; their special cases are begun too",
    )
    scattered: int = number(
        32,
        "starts of an output-error fit of a nominal model of which the data do not tell every state",
        "3 of 32 led a cell with a time constant ten times off to its maximum",
        "tests",
    )
    spread: float = number(
        2.0,
        "standard deviation of the logarithm of such starts over the declared values",
        "declared values are off by a power of ten at most",
    )
    close: float = number(
        30.0, "log-likelihood within which the second start goes on beside the first", "cost", "tests"
    )
    margin: float = number(50.0, "log-likelihood that first steps of an exchange may still lack", "cost", "tests")
    finer: int = number(
        3, "times that a fit goes on with finer steps of the solver, where its law became faster than they are", "cost"
    )
    choices: int = number(12, "choices of an effect's nonlinear parameters in the score test", "cost")
    wide: float = number(
        0.03,
        "share of three times the rms speed over which forces change their sign where initial states are looked for",
        "a smoothing that a step of the solver follows",
        "a falling reaction wheel's pendulum ended 40 % above its least error, and at it with widths of 0.6 to 9 %",
    )
    knots: int = number(25, "test functions on one axis of a free force", "a law of friction has two bends")
    joint_knots: tuple[int, int] = number((9, 6), "test functions on each of two axes", "cost: 54 together")
    own_starts: tuple[float, ...] = number(
        (0.125, 0.375, 0.625, 0.875),
        "where phases and instants of a validation record are looked for, as parts of a turn or of the record",
        "the middles of four quarters",
    )
    lines: int = number(3, "strongest lines of a force, over time or along a coordinate, that are tried", "cost")
    untold: float = number(
        1.0,
        "standard deviation of the logarithm of a smoothing width or the like from which it costs no parameter",
        "not known to a factor e: the data say nothing of it",
    )
    instants: int = number(
        48,
        "instants of a record that are tried where something happened once, after the fit from the nearest start",
        "one every 0.4 s of 20 s: along such a grid the likelihood of payload steps rose to one top",
        "judged records of 290000, which judge no more",
    )
    closer: int = number(
        8,
        "parts of the distance of such instants that are tried next to the likeliest, until a sample is reached",
        "cost",
    )
    negligible: float = number(
        1e-3,
        "latent force over the typical force below which play and hidden resonances have nothing to explain",
        "a fiftieth of an effect worth finding",
    )
    push: float = number(
        1e-3,
        "size of a push of an FMU in difference quotients, over that of its inputs",
        "well above what a solver rounds off",
    )
    wide_push: float = number(
        0.1,
        "and of one that is convolved with others, where the model allows it",
        "where inputs rest a solver errs by 2 % of what the smaller one does",
    )
    pushes: int = number(
        16,
        "pushes of an FMU from which on a few runs are spent to learn whether one response tells those to all",
        "cost; the push that asks changes its sign so often",
    )
    steady: float = number(
        0.01,
        "how far a response may be off its convolution with that to a pulse, over its size",
        "a score errs by its square",
    )
    descents: int = number(
        2,
        "starts from which an error that remembers is followed to its likeliest",
        "cost; with three the likelihoods of four sets of made-up errors were the same to 0.1",
    )
    pile: float = number(
        0.004,
        "share of the readings at the largest value from which saturation is tried, however little the score test says",
        "more than the peaks of a swing",
        "tests",
    )
    pile_width: float = number(
        9.0,
        "noises below the largest reading that count as at it",
        "of thousands of readings at a ceiling the largest lies four above it, and the least four below",
    )
    pile_flat: float = number(
        1.7,
        "readings within four such widths over those within one, at most: more are peaks of a swing",
        "a peak is a parabola and has twice as many; sensors at their ceiling had 1.00 to 1.40, swings 2.05 to 4.8",
        "seeds below 1000",
    )


EFFORT = Effort()
