"""Every number that decides in the closed loop: its value, the reason, where it is from, and what it was tuned on."""

from __future__ import annotations

from dataclasses import dataclass

from harness.diagnosis.number import number


@dataclass(frozen=True)
class Policy:
    """The deciding numbers of a diagnosis."""

    evidence: float = number(
        5.0,
        "an effect must raise the log-likelihood by this much a use: penalised where it was fitted, and held out",
        "Kass & Raftery 1995, J. Am. Stat. Assoc. 90:773, sec. 3.2: a difference of 10 in BIC is very strong",
        "base 220000: of 193 records with nothing missing none had a candidate beyond it but lines of the disturbance",
    )
    gain_z: float = number(
        2.0,
        "and that of both uses by at least this many standard errors over blocks",
        "two standard errors of what surprises the model (Vuong 1989): 97.5 %, whatever colour the noise has",
        "tanks, drives; at 1.5 a payload was named in 1 of 174 disturbed records of base 230000 with nothing missing",
    )
    alone: float = number(
        0.0,
        "and that of the estimation records alone by this much",
        "BIC does not speak against it (Schwarz 1978)",
        "base 230000: of 373 records with nothing missing none got a false name by it",
    )
    alone_z: float = number(
        1.0,
        "and that of the validation records alone by this many standard errors",
        "what was fitted must help where it was not: 84 %, as one use has half of what both together say",
        "base 220000; a magnet at one angle in the tests",
    )
    day: float = number(
        0.3,
        "standard deviation of the level of dry friction from one day to another, over the level",
        "Bittencourt & Gunnarsson 2012, J. Dyn. Sys. Meas. Control 134:051013: load and temperature change a joint's",
        "four free swings of one pendulum: .075, .083, .087 and .14",
    )
    zero: float = number(1.0, "the same of an instrument's zero", "set anew each day, it may as well have been none")
    sized: float = number(
        0.5,
        "share of the gain that the size of an effect promises of the validation records, below which, by more than "
        "their errors, they deny that size",
        "there the size that they want is three quarters of what was fitted: Sum d (2 e - d) over Sum d d",
        "base 300000: of 13 right effects .84 or more; .15 of a bent scale of a circuit that has none, .36 of a cyclic "
        "sensor error beside a magnet (base 310000)",
    )
    blocks: int = number(20, "blocks of a record, for standard errors under misspecified noise", "Kuensch 1989")
    second_share: float = number(
        0.03,
        "a further effect must bring this share of what all bring together where they are fitted: less is the rounded "
        "corner of the first",
        "hidden laws have sharp corners, those of the dictionary rounded ones",
        "seeds below 1000",
    )
    least: float = number(
        3e-4,
        "share of rates or readings that an effect must change, however sure it is: below it nobody would miss it",
        "the steps of an engine look like an effect of 1.2e-4 to 1.4e-4; the faintest real law seen changes 5.4e-4",
        "judged records of the base before",
    )
    tie: float = number(
        3.0,
        "rivals tie whose log-likelihoods differ by less",
        "Kass & Raftery 1995: a Bayes factor below 20 is no strong evidence",
    )
    tie_z: float = number(
        2.0,
        "or by less than this many standard errors over blocks: what a free run, other parameters, a drift change, too",
        "two standard errors: 95 %",
    )
    seen: float = number(
        0.003,
        "share of an effect's column that the nominal parameters must not be able to take up",
        "below it the two cannot be told apart in these data",
        "seeds below 1000",
    )
    clear: float = number(
        0.1,
        "share of a column from which on the promise of the score test is trusted",
        "columns are off by a few percent, as forces between samples are averaged",
        "seeds below 1000",
    )
    lead: float = number(
        3.0, "an effect is refitted if the score test promises this much", "Rao 1948; a promise is no bound: see reach"
    )
    reach: float = number(
        0.25,
        "a refit is finished if its first steps gain this share of the best one's, and of what acceptance asks; a pair "
        "is fitted if a column promises this share of what it would need",
        "the last steps of a fit gained up to three times what the first ones had; a drag beside friction brought 71 "
        "and its column had promised 29",
        "seeds below 1000",
    )
    most: int = number(3, "effects in one answer", "more were never told apart in 20 s records")
    rounding: float = number(
        0.05,
        "share of the sensor noise's power that rounding must make to be named",
        "every file is rounded somewhere; below a twentieth nobody would see it gone",
    )
    order: int = number(
        4,
        "coefficients of the error of a free run's output, or of an arm's joint",
        "two for a drift beside noise, two for a line of the spectrum; every candidate has as many",
    )
    window: float = number(
        0.5,
        "share of the horizon that free runs are fitted over where a plant loses its start: an error grows 4.5 times",
        "over the whole horizon, 20 times, the fit of a balanced cart-pole crept along a curved valley for 60 steps",
        "tests",
    )
    misfit_nrmse: float = number(
        0.5,
        "a nominal or repaired model whose prediction over the horizon leaves more than this share does not fit",
        "NRMSE 1 is the mean of the record: half of the motion unexplained is no model of it",
    )
    misfit_force: float = number(
        0.7,
        "a latent force of this share of what moves a coordinate: the model explains next to none of it",
        "where the model fits, the latent force is what it lacks: missing effects of the study are 2 to 20 %",
        "seeds below 1000, recordings",
    )
    misfit_gain: float = number(
        50.0,
        "log-likelihood that the repair of a column must gain to be named, and an effect or a free force where it was "
        "fitted to be told though the validation records show nothing of it; that of free runs beside an error that "
        "remembers, where the validation records alone lose",
        "ten times the evidence of an effect",
    )
    disturbed: float = number(
        0.05,
        "latent force over the typical force up to which a model is called adequate without reserve",
        "an effect of this size counts as one worth finding",
    )
    large: float = number(
        0.2,
        "latent force over the typical force beyond which it is no small disturbance, predictable or not",
        "four times the size of an effect worth finding",
        "laws outside the dictionary in the tests",
    )
    line_parts: tuple[int, ...] = number(
        (2, 4, 8, 16),
        "parts of a record in which a line may be drawn anew, and then be likelier noise than a periodic force",
        "noise in a band of B hertz loses its phase within some 1/B seconds: 10 s to 1.25 s of a record of 20 s",
        "judged records from 150000 and of 220000, which judge no more",
    )
    explained: float = number(
        0.05,
        "share of the variance left, at most, to call a model adequate, and by which free runs must come nearer",
        "a fit of 95 %",
    )
    proxy: float = number(
        0.5,
        "share of the variance left beyond which a model is a proxy at best, whatever the likelihood says",
        "half of the motion unexplained is no model of it",
    )
    further: float = number(
        5.0,
        "times as far as on the estimation records that free runs err on the validation records, from which on "
        "something acts there that the model lacks",
        "at most 1.9 in 18 records with nothing missing, 3.2 where a drive tires; at most 1.5 in 16 of base 450000",
        "study base 440000, every 7th without an effect",
    )
    once: float = number(
        0.5,
        "share of the lasting errors of free runs that a law of one event may leave",
        "what goes on as much as the event has done is no matter of an instant",
        "an oven under a draught: 0.9 and more on one of both uses; a tank whose inflow drops: 0.001",
    )
    shown: float = number(
        12.0,
        "largest eigenvalue times a sample time, at rest, of what an effect may add, or twice the nominal model's own",
        "exp(-12) is left of it at the next reading; lags of actuators are bounded at 10",
        "base 535000: right answers lie at 8.3 and below, lags on their bound at 10.0; motors without mass at 85",
    )
    shaken: float = number(
        8.0,
        "standard deviations by which a force that nobody measured changes within a sample, from which on something "
        "happened there",
        "at most 5.9 in 24 records with nothing missing; at least 17 where a force comes or goes",
        "study base 1000",
    )
    mostly: float = number(
        0.5, "share of a variance, or of what a channel errs, from which on it is said to be most of it", "the word"
    )
    changed: float = number(
        1.05,
        "factor between two errors below which nothing is said to have changed",
        "5 % of an error is seen by nobody",
    )
    widest: float = number(
        1e4,
        "ends of an interval of something positive that differ by more than this factor determine nothing",
        "judgement: two decades to either side of its middle",
    )
    chance: float = number(
        0.02,
        "probability that a reading lies within 1 % of a step of a grid point though there is no grid",
        "2 % of a step lie so",
    )


POLICY = Policy()


@dataclass(frozen=True)
class ArmPolicy:
    """What an arm needs beside :class:`Policy`, which holds for its joints too."""

    sticks: float = number(
        2 / 3,
        "a joint that stands still for more than this share of the time is not judged",
        "what it does while it stands still counts nowhere, and a third of a record is enough to judge by",
        "a sine stands still for 5 % of its time, a sum of many for 8 %, a log with its pauses for a third (a UR10e)",
    )
    pauses: float = number(
        0.25,
        "share of the time that a joint may stand still where elastic joints are looked for",
        "what sticks and starts rings as springs do: two were named where a joint stood still for 31 % of the time",
        "a sine stands still for 5 % of its time; records with friction and without pauses do for 19 % at most",
    )
    sensor: float = number(
        0.005,
        "an effect must change this share of a joint's torque, and what is left less: below it nothing is blamed",
        "no torque sensor is more exact",
    )
    alone: float = number(
        3.0,
        "by how much an effect must raise the log-likelihood of the estimation records alone",
        "Kass & Raftery 1995: a Bayes factor below 20 is no strong evidence",
        "an elasticity that is not there in the wrist of an arm: 2 where it was fitted, 34 +- 13 where it was not",
    )
    alone_z: float = number(
        2.0,
        "standard errors by which the validation records alone must gain",
        "regressors come from measured motion, and what their noise explains in one record it explains in every record",
        "an elasticity that is not there in the wrist of a simulated arm: 13 +- 8",
    )
    detail: float = number(
        0.02,
        "an effect on the whole arm below this share of the friction beside it is a detail of the friction's law",
        "dry friction is known to a few percent",
        "seeds below 1000",
    )
    own: int = number(
        5, "effects of one joint", "a geared one has dry and viscous friction and a rotor before anything is wrong"
    )
    wide: int = number(6, "effects on the whole arm, wrong torque gains among them", "cost")
    lightest: float = number(-0.95, "relative error of a link that leaves it next to no mass", "none is below nothing")
    gyration: float = number(
        0.5, "largest radius of gyration [m] of a link whose tensor a URDF does not state", "half a link of a metre"
    )
    unfiltered: float = number(
        0.9, "corner over half of the sample rate from which on nothing is filtered", "the filter would ring there"
    )
    gains_tried: tuple[float, ...] = number(
        (0.8, 0.5, 0.35),
        "torque gains from which a fit starts in the place of a rotor",
        "a rotor is never below nothing, and geared up a few times the link at most",
    )
    angle: float = number(
        0.3,
        "largest joint zero, tilt and flexure [rad]",
        "their torques are taken at first order, which is off by 5 % there: sin(x) = x - x^3/6, cos(x) = 1 - x^2/2",
    )
    gain: float = number(
        3.0,
        "a torque that is wrong by more than this factor is in another unit, or on the other side of a gear",
        "torque constants are off by percents",
    )
    unit_within: float = number(
        1.5, "factor within which a torque gain is a change of unit", "units lie a factor of ten apart"
    )
    late: float = number(
        0.1,
        "angle of the fastest motion by which a torque's clock may be off [rad]",
        "its column is of first order: 0.5 % off there; half a second between two columns of one joint is no clock",
    )
    rows_late: float = number(3.0, "and rows, where that is more", "a log is written before or after a step or two")
    other_arm: float = number(
        0.25,
        "torques of freely fitted bodies over the URDF's, apart, from which on it may be another arm's",
        "CAD is right within a tenth; a payload alone is one effect, and is named",
        "URDFs with masses halved or lengths times 0.7: 0.5 and more",
    )
    reweighed: int = number(
        3,
        "fits of another arm: the first weighs a joint by its torque, the others by what the one before left of it",
        "the weights are those of the noise from the third on",
        "an iiwa with lengths times 0.7: 0.16, 0.018 and 0.012 N m are left at its second joint",
    )
    as_well: float = number(
        2.0,
        "residual of another arm's torques over that of the effects that were found, up to which no joint is lost",
        "a hundred parameters of one record err by about the noise in the next; a wrong gain, which no arm is, by more",
        "an iiwa with lengths times 0.7 and 1.4: 0.9 to 1.0; with all masses halved: 1.75 at a wrist",
    )
    far_better: float = number(
        0.5,
        "the same at the joint where it is smallest, from which on another arm explains more than what was found",
        "an arm can be any payload or link: where these are the truth it leaves what they leave",
        "the same lengths: 0.02 to 0.15; links halved and named: 0.9",
    )
    drive: float = number(
        1.3,
        "factor on a joint's torque beyond which, at two joints, the bodies are wrong and not the drives",
        "torque constants are off by a tenth, lengths and masses of another arm by more",
        "URDFs with masses halved or lengths times 0.7: gains of .43 to .6",
    )
    by_itself: float = number(
        0.7,
        "the same over that of every joint's own friction and rotor, above which joints explain themselves",
        "bodies that mend half of the power do what no rotor does",
        "few records: wrong URDFs below 0.3; hidden rotors mostly above 0.9, some as low as 0.03",
    )
    sure: float = number(3.0, "standard errors of a noise level that are allowed for", "99.7 %")
    silent: float = number(
        0.001, "largest torque of an effect over the error below which it shows nothing", "a thousandth of the noise"
    )
    faster: float = number(
        4.0, "times the band of the motion above which a joint hardly follows its torque", "two octaves"
    )
    loud: float = number(0.1, "chatter over the rms of the torque that matters", "a tenth")
    flat: float = number(
        1.9, "kurtosis below which a fast torque swings between two levels", "a square wave has 1, a sine 1.5, noise 3"
    )
    often: float = number(0.1, "share of the time in which it must do so", "a stretch of noise rarely looks like it")
    calm: float = number(2.0, "corner of the calm motion over the band of the motion", "an octave")
    clear: float = number(
        100.0,
        "power of a position or rate over its noise up to which the calm motion goes beyond that",
        "its noise takes a hundredth of an inertia there; a fast torque lies where its motion is small",
        "rotors of .01 to .2 kg m^2 at joints on multisine torques of 8 Hz",
    )
    still: float = number(0.1, "speed over its rms below which a joint stands still", "a tenth of its motion")
    several: int = number(2, "effects from which on they may be another arm together", "one alone is what it is called")
    moved: float = number(
        1e-4,
        "relative size below which torques do not move with a direction of the inertial parameters",
        "judgement: far above rounding, far below what is felt",
    )
    by_chance: float = number(
        0.001, "level of the test whether what real bodies cost is chance", "judgement: one false alarm in a thousand"
    )
    turning: float = number(
        0.02,
        "width of the sign of a joint's speed over its rms speed",
        "a sine spends 0.9 % of its time there",
    )
    rounded: float = number(
        1e-4, "share of a rotor's torque below which what bodies leave of it is rounding", "as for a direction"
    )
    below: float = number(
        5.0,
        "standard errors below nothing, in every use, from which on an inertia is impossible",
        "one in three million of one use",
    )
    untold: float = number(
        0.05, "share of the inertia's own direction that the motion may leave untold", "it moves the mean by as much"
    )
    told: float = number(
        1e-6, "singular value, over the largest, from which on the motion tells a direction", "half of the digits"
    )
    link: float = number(
        0.05,
        "relative error of the mass of a link up to which it is not named beside other links",
        "CAD is right within a tenth, and errors of the motion ask for that much",
        "two of the 20 logs with wrong masses whose counts stand in the limits",
    )
    slowest_spring: float = number(
        4.0,
        "lowest resonance of a link on its joint's spring that a fit starts from [Hz]",
        "half of the slowest that light arms are known for",
    )
    fastest_spring: float = number(
        80.0, "highest of them [Hz]", "beyond, a compliance shows at first order, whatever the resonance"
    )
    springs: int = number(
        9, "resonances that are tried in between", "a factor of 1.45: within the reach of a fit of half a decade"
    )
    spring: float = number(
        0.002,
        "change of a joint's torque below which a spring is not named",
        "it acts where the torque is small, above the motion; a rotor or a gain of the torque would take its place",
        "springs of 21 to 27 Hz along a motion clear to 10 Hz: .0023 to .0049, at log-likelihoods of 60 to 330",
    )
    resolved: float = number(0.25, "highest of them over the sample rate", "four samples in a period")
    damped: float = number(0.03, "damping ratio that a spring starts from", "gears of steel have 0.01 to 0.1")
    least_lag: float = number(1e-5, "damping over stiffness of a joint, at least [s]", "0.3 % at 100 Hz: none")
    most_lag: float = number(
        0.1, "and at most [s]", "a damper that slow is a clutch; the square of it is J/k of a rotor at 1.6 Hz"
    )
    small_spring: float = number(
        1e-3, "compliance over the smallest that is tried at which its torque is in proportion to it", "0.1 %"
    )
    softest: float = number(
        1e-6, "least value of what is fitted by its logarithm, over its largest", "far below what any motion shows"
    )
    kept: float = number(
        0.4, "band of a motion over the rate of the rows that are kept of it", "the filter of decimated rows keeps that"
    )
    fewest: int = number(
        100,
        "rows that a record must have in the band of its clear motion where elastic joints are looked for",
        "ten times what a joint has by itself: six columns, four coefficients of its error",
    )
    sets: int = number(3, "sets of links that are fitted with errors of their own, the best by one metric", "cost")
    rows: int = number(4000, "samples of a use that are asked for an inertia", "cost: there are five columns")


ARM_POLICY = ArmPolicy()


@dataclass(frozen=True)
class PlanPolicy:
    """What the comparison of effects before an experiment needs."""

    visible: float = number(
        0.02,
        "share of an effect's column that the nominal parameters must not be able to take up, to promise it is seen",
        "columns are approximate: a gain that all parameters take up exactly kept shares of 0.004 to 0.015",
        "pendulum and cart-pole under multisines",
    )
    alike: float = number(
        0.95, "cosine beyond which two effects are said to look alike", "a tenth of either is left to tell them apart"
    )
    noise: float = number(0.01, "sensor noise over the size of an output, where a scenario has none", "a common sensor")
    upright: float = number(
        1.2, "angle that slow swings stay below [rad]", "beyond 90 deg a pendulum falls, and then it is not slow"
    )
    stronger: float = number(
        32.0, "times by which an input is asked to grow over the data", "what a plant is known to bear"
    )
    shortest: float = number(20.0, "seconds of a proposed experiment, at least", "some swings of a slow arm")
    longest: float = number(60.0, "and at most, or three times the least that it must last", "patience")
    rows: int = number(500, "rows of it, at least", "some for each of the parameters")
    settled: float = number(5.0, "of the plant's slowest time constants in it, at least", "an answer is over to 1 %")
    periods: int = number(6, "of a slow triangle", "two at each of three amplitudes")


PLAN_POLICY = PlanPolicy()


@dataclass(frozen=True)
class DataPolicy:
    """What the data must be like, and how they are cut, before they are judged."""

    longest_dead: int = number(
        200, "samples of dead time that are looked for, a tenth of a record at most", "cost; little is left beyond it"
    )
    dead_lags: int = number(
        4, "lags of every signal beside a dead time", "a plant of second order and one mode of it that is not modelled"
    )
    clearer: float = number(
        0.8, "least-squares loss with a dead time over that without, at most", "noise changes it by some percent"
    )
    unexplained: float = number(
        0.5,
        "error over the motion within a window above which a rough fit explains next to nothing",
        "half of the motion is no model of it",
    )
    repaired: float = number(
        0.2,
        "share of that error below which a repair of a column must bring it",
        "a fivefold fall is no accident of a fit",
    )
    repair_clear: float = number(
        0.03, "error over the motion below which a model fits the columns, whatever a repair leaves", "3 % is a fit"
    )
    far: float = number(
        100.0,
        "factor of a parameter from its declared value beyond which the columns as they are do not fit",
        "a unit wrong by 1000 moves parameters by a power of 1000; halfway is 30",
    )
    near: float = number(
        10.0, "and within which a repair must bring it", "a power of ten, as declared values are rough"
    )
    declared: float = number(
        1.3,
        "factor of its declared value within which every parameter must come by a repair of degrees alone",
        "degrees for radians are a factor of 57, which a plant may be off: closer than that is no accident",
    )
    integrates: float = number(1e-6, "pole over the largest, below which it is one at 0", "rounding is far below")
    growth: float = number(
        20.0,
        "by how much an error of the initial state may grow within a window",
        "three doublings of the noise and more hide what the model lacks",
    )
    per_period: int = number(
        40,
        "samples kept in one period of the fastest motion",
        "dry friction shows in tens of harmonics of the swing",
    )
    per_force: int = number(
        6,
        "samples kept in one period of the fastest force, where an input brings forces of its own",
        "three times what a period needs: where it reverses, friction changes the acceleration at once",
    )
    fewest: int = number(
        500, "samples that every thinned record must still have", "blocks of 25 samples for 20 standard errors"
    )
    corner: float = number(
        1e-4,
        "chance that noise alone keeps the readings of a window off the cubic by more than allowed: then the reading "
        "counts itself",
        "one kept reading in ten thousand",
    )
    jump: float = number(
        0.1,
        "share of the noise of a kept reading by which a jump of the acceleration may move it",
        "a bias of a tenth changes the chance of a reading by half a percent; averages over wider windows made the "
        "corners of an engine's friction Stribeck friction",
        "seeds below 1000",
    )
    ringing: int = number(
        20,
        "samples from either end in which a twice differentiated interpolation rings",
        "outliers of ten deviations there passed for an error that remembers",
        "seeds below 1000",
    )
    rows_late: int = number(2, "rows by which a recorded input may be late", "a log is written a step or two off")
    own_values: float = number(
        3.0,
        "times their declared values that parameters may take for an input that follows a law to count as late",
        "a controller would have to have the plant's own resistance, inductance and so on as its gains",
        "a motor whose current answers at once; controllers of a motor, a pendulum and an oven",
    )
    rows_tried: tuple[float, ...] = number(
        (1.0, 1.5, 2.0, 2.5), "rows that are tried as long as each is likelier than the one before", "halves of a row"
    )
    input_left: float = number(
        0.05,
        "share of an input's variance that piecewise linear ones may leave",
        "what a fit of 95 % leaves; the motion is exact all the same, a law of the input is not",
    )
    long: int = number(
        40000,
        "samples of the records of a use beyond which the search looks at stretches",
        "cost: every fit filters them tens of times",
    )
    stretch: int = number(2500, "samples of a stretch", "ten seconds at 250 Hz")
    stretches: int = number(4, "and how many", "as many samples together as two records of 20 s at 250 Hz")
    hopeless: float = number(
        60.0, "log-likelihood below the best path of signs at which a path is no longer followed", "a chance of 1e-26"
    )
    same: float = number(
        0.5,
        "distance of the states of two paths, in standard deviations, below which they go on as one",
        "less than one is no difference",
    )
    rival: float = number(
        5.0, "log-likelihood within which a path rivals the best one", "a Bayes factor of 150: Kass & Raftery 1995"
    )
    turn: float = number(10.0, "log-likelihood that every change of the sign must bring", "twice that of an effect")
    near_zero: float = number(0.1, "reading over the rms below which its sign is open", "a tenth of a swing")
    shortest: int = number(
        50, "samples that a piece of a record has at least", "fewer do not tell its initial state from its parameters"
    )
    look: int = number(2000, "samples on which a parameter of an FMU must move an output to be calibrated", "cost")


DATA_POLICY = DataPolicy()


@dataclass(frozen=True)
class RunPolicy:
    """What decides about intervals and tests of fitted runs."""

    bias_level: float = number(0.01, "level of the test for a bias by feedback", "one false alarm in a hundred")
    weak: float = number(
        0.3,
        "cosine to the instruments below which a direction of the parameters is not instrumented",
        "a tenth of its variance",
    )
    matters: float = number(
        1.0, "shift in standard errors from which on the intervals are not usable", "a shift of one takes 95 % to 83 %"
    )
    interval_blocks: int = number(20, "blocks of a record for the jackknife", "Kuensch 1989")
    fewest_blocks: int = number(
        4, "blocks of a residual that stays coloured for long", "with fewer Student's t is of no use"
    )
    correlation_times: float = number(10.0, "length of a block in correlation times", "neighbours then share little")
    means: int = number(
        20, "means that a scale needs to tell whether a residual is white", "with fewer it tells nothing"
    )
    white_level: float = number(0.01, "level of the test that a residual is white", "one false alarm in a hundred")
    determined: float = number(
        0.02, "share of a direction that a block must leave to the others", "without it there is no estimate"
    )


RUN_POLICY = RunPolicy()
